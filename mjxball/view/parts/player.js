// The player: one clock and one camera for all flights; each flight has a scene, readouts, marks and plots.

// The array that each part of a scene needs.
const NEEDED = { thrust: 'thrust', contact: 'contact_force', weight: 'object_mass', path: 'position' };
const DEGREES = 180 / Math.PI;

const FINE = 20;  // largest error of the plot near the goal [mm]

// Plots of a flight, for the arrays that it has.
function recipes(flight) {
  const line = (name, its, value, dash) => ({ name, colour: its, value, dash });
  const { leader, axes: along } = flight.plant;
  const drones = (value) => flight.plant.drones.map(({ name }, drone) =>
    line(name, flight.colour(drone), (row) => value(row, drone), flight.dash(drone)));
  const command = (index, factor) => drones((row, drone) => factor * (drone === leader
    ? flight.get('leader_command', row, index)
    : flight.get('follower_command', row, 3 * (flight.place(drone) - 1) + index)));
  const of = (array) => drones((row, drone) => flight.get(array, row, drone));
  const found = [];
  const plot = (needed, title, unit, series) => {
    if (flight.has(needed)) found.push({ title, unit, series: series() });
  };
  plot('target', 'Error to the goal', 'm', () => ['x', 'y', 'z'].map((name, k) =>
    line(name, name, (row) => flight.error(row, k))));
  plot('target', `Error near the goal, up to ±${FINE} mm`, 'mm', () => ['x', 'y', 'z'].map((name, k) =>
    line(name, name, (row) => clamp(1000 * flight.error(row, k), -FINE, FINE))));
  plot('cg_offset', 'CG from the centre', 'cm', () => along.map((axis, k) => {
    const [name, its] = along.length === 1 ? ['offset', 'cg'] : ['xy'[axis], 'xy'[axis]];
    return line(name, its, (row) => 100 * flight.get('cg_offset', row, k));
  }));
  plot('euler', 'Attitude', '°', () => ['roll', 'pitch', 'yaw'].map((name, k) =>
    line(name, 'xyz'[k], (row) => DEGREES * flight.get('euler', row, k))));
  plot('leader_command', 'Commanded pitch', '°', () => command(1, DEGREES));
  plot('leader_command', 'Commanded roll', '°', () => command(0, DEGREES));
  plot('leader_command', 'Commanded vertical acceleration', 'm/s²', () => command(2, 1));
  plot('thrust', 'Thrust', 'N', () => of('thrust'));
  plot('contact_force', 'Contact force on the object', 'N', () =>
    drones((row, drone) => flight.push(row, drone)));
  plot('hidden', 'What the follower’s network remembers', 'units, −1 blue to 1 red', () =>
    [{ name: '', colour: 'none', array: 'hidden', units: flight.width('hidden'), value: () => 0 }]);
  plot('battery', 'Battery', 'V', () => of('battery'));
  plot('late', 'Lateness of the loop', 'ms', () =>
    [line('late', 'weight', (row) => 1000 * flight.get('late', row, 0))]);
  return found;
}

// One flight on the page.
class Pane {
  constructor(flight, player) {
    this.flight = flight;
    const view = document.getElementById('view').content.cloneNode(true).firstElementChild;
    document.getElementById('views').append(view);
    view.querySelector('h2').textContent = flight.title;
    view.querySelector('.who').replaceChildren(...flight.plant.drones.map(({ name }, drone) => {
      const label = element('span');
      label.append(swatch(flight.colour(drone)), ` ${name}`);
      return label;
    }));
    view.querySelector('.facts').replaceChildren(...flight.facts.map(([name, value]) => {
      const fact = element('div');
      fact.append(element('dt', name), element('dd', value));
      return fact;
    }));
    this.tell = (name, text) => { view.querySelector(`.now-${name}`).textContent = text; };
    view.querySelector('.now-cg').parentElement.hidden = !flight.has('cg_offset');
    this.phase = view.querySelector('.now-phase').parentElement;
    this.scene = new Scene(view.querySelector('canvas'), flight, player.camera, player.shown);
    this.marks = element('div', '', 'marks');
    document.getElementById('marks').append(this.marks);
  }

  // Place the marks on the time axis from `from` to `to` [s].
  mark(from, to, player) {
    const { marks } = this.flight, phases = marks.filter(({ kind }) => kind === 'phase');
    const share = (time) => 100 * clamp((time - from) / (to - from), 0, 1);
    this.marks.hidden = !marks.length;
    this.marks.replaceChildren(...marks.map((mark) => {
      const made = element('span', mark.kind === 'phase' ? mark.text : '', `${mark.kind} ${mark.level}`);
      const next = phases[phases.indexOf(mark) + 1];
      made.title = `${mark.time.toFixed(1)} s: ${mark.text}`;
      made.style.left = `${share(mark.time)}%`;
      if (mark.kind === 'phase') {
        made.style.width = `${share(next ? next.time : this.flight.last) - share(mark.time)}%`;
      }
      made.onclick = () => player.seek(mark.time);
      return made;
    }));
  }

  draw(now) {
    this.scene.draw(this.flight.rowAt(now));
    this.plots.forEach((plot) => plot.draw(now));
  }

  // Update the readouts to the time `now`.
  read(now) {
    const { flight } = this, row = flight.rowAt(now), phase = flight.markAt('phase', now);
    const [roll, pitch] = flight.at('euler', row);
    this.tell('error', `${Math.hypot(...[0, 1, 2].map((k) => flight.error(row, k))).toFixed(3)} m`);
    this.tell('tilt', `${(DEGREES * Math.hypot(roll, pitch)).toFixed(1)}°`);
    if (flight.has('cg_offset')) {
      const offset = flight.at('cg_offset', row).map((c) => fixed(100 * c, 0.1));
      this.tell('cg', `${offset.join(', ')} cm`);
    }
    this.phase.hidden = !phase;
    if (phase) this.tell('phase', phase.text);
    this.plots.forEach((plot) => plot.read(row));
  }
}

class Player {
  constructor(flights) {
    Object.assign(this, { camera: new Camera(), shown: {}, playing: false });
    for (const name of ['play', 'seek', 'speed', 'width', 'time']) {
      this[`${name}Control`] = document.getElementById(name);
    }
    document.querySelector('main').classList.toggle('pair', flights.length > 1);
    this.panes = flights.map((flight) => new Pane(flight, this));
    this.makePlots();
    this.makeToggles();
    this.widthControl.onchange = () => this.draw();
    this.playControl.onclick = () => this.toggle();
    this.seekControl.oninput = () => this.seek(+this.seekControl.value);
    this.panes.forEach(({ scene }) => listen(scene, this));
    document.addEventListener('keydown', (event) => keyed(event, this));
    document.addEventListener('theme', () => this.draw());
    document.addEventListener('scroll', () => this.draw(), true);  // plots that are out of sight are not drawn
    new ResizeObserver(() => this.draw()).observe(document.body);
    this.fit();
    this.seek(this.first);
  }

  get first() { return Math.min(...this.panes.map(({ flight }) => flight.first)); }

  get last() { return Math.max(...this.panes.map(({ flight }) => flight.last)); }

  // Plots of the same kind stand side by side.
  makePlots() {
    const parent = document.getElementById('plots'), peers = {};
    const found = this.panes.map(({ flight }) => recipes(flight));
    const titles = new Set(found.flat().map(({ title }) => title));
    this.panes.forEach((pane) => { pane.plots = []; });
    for (const title of titles) {
      found.forEach((own, k) => {
        const { flight, plots } = this.panes[k], recipe = own.find((one) => one.title === title);
        peers[title] ||= [];
        const kind = recipe?.series[0].units ? Strips : Plot;
        if (recipe) plots.push(new kind(parent, recipe, flight, peers[title], this));
        else parent.append(element('div'));
      });
    }
  }

  makeToggles() {
    const parent = document.getElementById('shown'), { reach } = this.world();
    const scale = (kind) => `${short(0.1 / reach[kind])} N per 10 cm`;
    const labels = {
      thrust: () => `thrust, ${scale('thrust')}`,
      contact: () => `contact forces, ${scale('contact')}`,
      weight: () => `weight, ${scale('contact')}`,
      path: () => 'path',
    };
    const toggle = (id, checked, change, ...contents) => {
      const label = element('label'), box = element('input');
      Object.assign(box, { type: 'checkbox', checked, id });
      box.onchange = () => { change(box.checked); this.draw(); };
      label.append(box, ...contents);
      parent.append(label);
      return box;
    };
    this.followControl = toggle('follow', false, (on) => this.follow(on), 'follow the rig');
    for (const [kind, text] of Object.entries(labels)) {
      if (!this.panes.some(({ flight }) => flight.has(NEEDED[kind]))) continue;
      this.shown[kind] = true;
      toggle(`show-${kind}`, true, (on) => { this.shown[kind] = on; }, swatch(kind), text());
    }
  }

  world() { return surroundings(this.panes.map(({ flight }) => flight), this.camera); }

  // Move the camera so that all flights are in view, and keep the user's rotation and zoom.
  fit() {
    const world = this.world(), { camera } = this, zoomed = camera.distance / camera.home.distance;
    camera.home.distance = world.distance;
    camera.distance = zoomed * world.distance;
    this.panes.forEach((pane) => { pane.scene.world = world; });
    Object.assign(this.seekControl, { min: this.first, max: this.last });
    this.panes.forEach((pane) => pane.mark(this.first, this.last, this));
  }

  // Centre the view on the rig, or stop following without a jump of the picture.
  follow(on) {
    const { camera, panes: [{ scene, flight }] } = this, row = flight.rowAt(this.now);
    const before = scene.target(row);
    camera.follow = on;
    camera.pan = on ? [0, 0, 0] : add(camera.pan, sub(before, scene.target(row)));
    this.followControl.checked = on;
    this.draw();
  }

  toggle() {
    this.playing = !this.playing;
    if (this.playing && this.now >= this.last) this.seek(this.first);
    this.playControl.textContent = this.playing ? '❚❚' : '▶';
    this.playControl.setAttribute('aria-label', this.playing ? 'pause' : 'play');
    this.stamp = undefined;
    if (this.playing) requestAnimationFrame((stamp) => this.frame(stamp));
  }

  frame(stamp) {
    if (!this.playing) return;
    const passed = this.stamp === undefined ? 0 : Math.min(0.25, (stamp - this.stamp) / 1000);
    this.stamp = stamp;
    this.seek(this.now + passed * +this.speedControl.value);
    if (this.now >= this.last) this.toggle();
    else requestAnimationFrame((next) => this.frame(next));
  }

  seek(time) {
    this.now = clamp(time, this.first, this.last);
    this.seekControl.value = this.now;
    this.draw();
  }

  // The plots show the whole flight, or some seconds around now.
  span() {
    const wanted = +this.widthControl.value, { first, last } = this, plots = this.panes.flatMap((pane) => pane.plots);
    const from = wanted ? Math.max(first, Math.min(this.now - wanted / 2, last - wanted)) : first;
    const to = wanted ? Math.min(last, from + wanted) : last;
    const rows = this.panes.reduce((sum, { flight }) => sum + flight.rows, 0), of = `${from} ${to} ${rows}`;
    if (this.spanned !== of) plots.forEach((plot) => plot.span(from, to));
    this.spanned = of;
    plots.forEach((plot) => plot.range());
  }

  draw() {
    this.span();
    this.panes.forEach((pane) => pane.draw(this.now));
    this.timeControl.textContent = `${this.now.toFixed(2)} s`;
    this.panes.forEach((pane) => pane.read(this.now));
  }
}
