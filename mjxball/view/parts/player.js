// The player: reads the flight, moves the time, and keeps scene, plots and controls together.
class Flight {
  constructor({ rows, arrays, plant }) {
    this.rows = rows;
    this.plant = plant;
    this.arrays = {};
    for (const [name, text] of Object.entries(arrays)) this.arrays[name] = Flight.unpacked(text);
    this.time = this.arrays.time;
  }

  static unpacked(text) {
    return new Float32Array(Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer);
  }

  // Rows that came later, packed alike.
  grow({ rows, arrays }) {
    for (const [name, text] of Object.entries(arrays)) {
      const before = this.arrays[name], added = Flight.unpacked(text), all = new Float32Array(before.length + added.length);
      all.set(before);
      all.set(added, before.length);
      this.arrays[name] = all;
    }
    this.rows += rows;
    this.time = this.arrays.time;
  }

  // A flight that is being flown knows no CG, object mass or contact force.
  has(name) { return name in this.arrays; }

  // Row `row` of the array `name`, flat.
  at(name, row) {
    const array = this.arrays[name], width = array.length / this.rows;
    return Array.from(array.subarray(row * width, (row + 1) * width));
  }

  column(name, index, factor = 1) {
    const array = this.arrays[name], width = array.length / this.rows;
    return Float32Array.from({ length: this.rows }, (_, row) => factor * array[row * width + index]);
  }

  largest(name) { return this.arrays[name].reduce((most, value) => Math.max(most, Math.abs(value)), 1e-6); }

  largestContact() {
    let most = 1e-6;
    for (let row = 0; row < this.rows; row++) {
      const force = this.at('contact_force', row);
      for (let k = 0; k < force.length; k += 3) most = Math.max(most, length(force.slice(k, k + 3)));
    }
    return most;
  }

  // Of drone number `drone`, in the scene and in the plots.
  colour(drone) {
    const { leader } = this.plant;
    return drone === leader ? COLOURS.leader : FOLLOWERS[(drone < leader ? drone : drone - 1) % FOLLOWERS.length];
  }

  bounds() {
    const low = [Infinity, Infinity, Infinity], high = low.map((v) => -v);
    for (const name of ['position', 'target']) {
      this.arrays[name].forEach((value, k) => {
        low[k % 3] = Math.min(low[k % 3], value);
        high[k % 3] = Math.max(high[k % 3], value);
      });
    }
    return { low, high };
  }

  // Some of the places where the object is, or should be.
  places() {
    const every = Math.ceil(this.rows / 200), found = [];
    for (let row = 0; row < this.rows; row += every) found.push(this.at('position', row), this.at('target', row));
    return found;
  }

  rowAt(time) {
    let low = 0, high = this.rows - 1;
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (this.time[middle] <= time + 1e-6) low = middle; else high = middle - 1;
    }
    return low;
  }
}

// The array that each part of the scene is drawn from.
const NEEDED = { thrust: 'thrust', contact: 'contact_force', weight: 'object_mass', path: 'position' };

class Player {
  constructor(flight) {
    Object.assign(this, { flight, playing: false, now: flight.time[0] });
    this.scene = new Scene(document.getElementById('scene'), flight);
    this.play = document.getElementById('play');
    this.seeker = document.getElementById('seek');
    this.speed = document.getElementById('speed');
    this.width = document.getElementById('width');
    this.width.onchange = () => this.draw();
    this.seeker.max = flight.rows - 1;
    this.plots = this.makePlots();
    this.makeToggles();
    document.getElementById('now-cg').parentElement.hidden = !flight.has('cg_offset');
    this.play.onclick = () => this.toggle();
    this.seeker.oninput = () => this.seek(flight.time[+this.seeker.value]);
    this.listen();
    new ResizeObserver(() => this.draw()).observe(document.body);
    this.seek(this.now);
  }

  makePlots() {
    const parent = document.getElementById('plots');
    return this.recipes().map(({ title, unit, series }) =>
      new (series[0].rows ? Strips : Plot)(parent, title, unit, this.flight.time, series, (time) => this.seek(time)));
  }

  // What is plotted of the arrays that the flight has.
  recipes() {
    const { flight } = this, degrees = 180 / Math.PI;
    const line = (name, colour, values, dash) => ({ name, colour, values, dash });
    const axes = ['#c92a2a', '#2b8a3e', '#1864ab'];
    const { leader, axes: along } = flight.plant;
    const drones = flight.plant.drones.map(({ name }, drone) => [name, flight.colour(drone)]);
    const command = (index, factor) => drones.map(([name, colour], drone) => (drone === leader
      ? line(name, colour, flight.column('leader_command', index, factor), [5, 3])
      : line(name, colour, flight.column('follower_command', 3 * (drone < leader ? drone : drone - 1) + index, factor))));
    const push = (drone) => Float32Array.from({ length: flight.rows }, (_, row) =>
      length(flight.at('contact_force', row).slice(3 * drone, 3 * drone + 3)));
    const of = (name) => drones.map(([drone, colour], k) => line(drone, colour, flight.column(name, k)));
    const found = [];
    const plot = (needed, title, unit, series) => { if (flight.has(needed)) found.push({ title, unit, series: series() }); };
    plot('error', 'Error to the goal', 'm', () => ['x', 'y', 'z'].map((name, k) => line(name, axes[k], flight.column('error', k))));
    plot('cg_offset', 'CG from the centre', 'cm', () => (along.length === 1
      ? [line('offset', COLOURS.cg, flight.column('cg_offset', 0, 100))]
      : along.map((axis, k) => line('xy'[axis], axes[axis], flight.column('cg_offset', k, 100)))));
    plot('euler', 'Attitude', '°', () => ['roll', 'pitch', 'yaw'].map((name, k) => line(name, axes[k], flight.column('euler', k, degrees))));
    plot('leader_command', 'Commanded pitch', '°', () => command(1, degrees));
    plot('leader_command', 'Commanded roll', '°', () => command(0, degrees));
    plot('leader_command', 'Commanded vertical acceleration', 'm/s²', () => command(2, 1));
    plot('thrust', 'Thrust', 'N', () => of('thrust'));
    plot('contact_force', 'Contact force on the object', 'N', () => drones.map(([name, colour], k) => line(name, colour, push(k))));
    plot('hidden', 'What the follower’s network remembers', 'units, −1 blue to 1 red', () => [{
      name: '', colour: 'transparent', values: flight.arrays.hidden, rows: flight.arrays.hidden.length / flight.rows }]);
    plot('battery', 'Battery', 'V', () => of('battery'));
    plot('late', 'Lateness of the loop', 'ms', () => [line('late', COLOURS.weight, flight.column('late', 0, 1000))]);
    return found;
  }

  makeToggles() {
    const parent = document.getElementById('shown'), { reach } = this.scene;
    const scaleOf = (kind) => `${short(0.1 / reach[kind])} N per 10 cm`;
    const labels = { thrust: `thrust, ${scaleOf('thrust')}`, contact: `contact forces, ${scaleOf('contact')}`, weight: 'object’s weight at the CG', path: 'path' };
    for (const [kind, text] of Object.entries(labels)) {
      if (!this.flight.has(NEEDED[kind])) continue;
      const label = element('label'), box = element('input');
      Object.assign(box, { type: 'checkbox', checked: true, id: `show-${kind}` });
      box.onchange = (event) => { this.scene.shown[kind] = event.target.checked; this.draw(); };
      label.append(box, swatch(COLOURS[kind]), text);
      parent.append(label);
    }
  }

  listen() {
    const { canvas, camera } = this.scene, fingers = new Map();
    const apart = () => { const [a, b] = [...fingers.values()]; return Math.hypot(a[0] - b[0], a[1] - b[1]); };
    canvas.addEventListener('pointerdown', (event) => {
      fingers.set(event.pointerId, [event.clientX, event.clientY]);
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener('pointermove', (event) => {
      const last = fingers.get(event.pointerId);
      if (!last) return;
      const before = fingers.size === 2 ? apart() : 0;
      fingers.set(event.pointerId, [event.clientX, event.clientY]);
      if (fingers.size === 1) camera.turn(event.clientX - last[0], event.clientY - last[1]);
      else if (fingers.size === 2 && before > 0) camera.zoom(before / Math.max(apart(), 1));
      this.draw();
    });
    for (const name of ['pointerup', 'pointercancel']) canvas.addEventListener(name, (event) => fingers.delete(event.pointerId));
    canvas.addEventListener('wheel', (event) => { event.preventDefault(); camera.zoom(Math.exp(0.001 * event.deltaY)); this.draw(); }, { passive: false });
    canvas.addEventListener('dblclick', () => { camera.reset(); this.draw(); });
    document.addEventListener('keydown', (event) => {
      if (event.target.matches('input, select, button')) return;
      if (event.key === ' ') { event.preventDefault(); this.toggle(); }
      if (event.key === 'ArrowRight') this.seek(this.now + 0.1);
      if (event.key === 'ArrowLeft') this.seek(this.now - 0.1);
    });
  }

  toggle() {
    this.playing = !this.playing;
    const { time, rows } = this.flight;
    if (this.playing && this.row === rows - 1) this.seek(time[0]);
    this.play.textContent = this.playing ? '❚❚' : '▶';
    this.play.setAttribute('aria-label', this.playing ? 'pause' : 'play');
    this.last = undefined;
    if (this.playing) requestAnimationFrame((stamp) => this.frame(stamp));
  }

  frame(stamp) {
    if (!this.playing) return;
    const passed = this.last === undefined ? 0 : Math.min(0.25, (stamp - this.last) / 1000);
    this.last = stamp;
    this.seek(this.now + passed * +this.speed.value);
    if (this.row === this.flight.rows - 1) this.toggle();
    else requestAnimationFrame((next) => this.frame(next));
  }

  seek(time) {
    const { flight } = this;
    this.now = Math.max(flight.time[0], Math.min(flight.time[flight.rows - 1], time));
    this.row = flight.rowAt(this.now);
    this.seeker.value = this.row;
    this.draw();
  }

  // The plots show the whole flight, or some seconds around now.
  span() {
    const { time, rows } = this.flight, wanted = +this.width.value, first = time[0], last = time[rows - 1];
    const from = wanted ? Math.max(first, Math.min(this.now - wanted / 2, last - wanted)) : first;
    this.plots.forEach((plot) => plot.span(from, wanted ? Math.min(last, from + wanted) : last));
  }

  draw() {
    const { flight, row } = this, euler = flight.at('euler', row);
    const tilt = Math.hypot(euler[0], euler[1]) * 180 / Math.PI;
    const tell = (name, text) => { document.getElementById(`now-${name}`).textContent = text; };
    tell('time', `${flight.time[row].toFixed(2)} s`);
    tell('error', `${length(flight.at('error', row)).toFixed(3)} m`);
    tell('tilt', `${tilt.toFixed(1)}°`);
    if (flight.has('cg_offset')) tell('cg', `${flight.at('cg_offset', row).map((c) => (100 * c).toFixed(1).replace('-', '−')).join(', ')} cm`);
    this.span();
    this.scene.draw(row);
    this.plots.forEach((plot) => plot.draw(row));
  }
}
