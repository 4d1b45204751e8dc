// One flight: flat arrays of `rows` rows, and values derived from them.
class Flight {
  constructor({ title, rows, arrays, plant, marks = [], facts = [] }) {
    Object.assign(this, { title, rows, plant, marks, facts, arrays: {}, kept: [0], seen: 1, step: 0.005 });
    for (const [name, text] of Object.entries(arrays)) this.arrays[name] = Flight.unpacked(text);
    this.time = this.arrays.time;
  }

  static unpacked(text) {
    const letters = atob(text), bytes = new Uint8Array(letters.length);
    for (let k = 0; k < letters.length; k++) bytes[k] = letters.charCodeAt(k);
    return new Float32Array(bytes.buffer);
  }

  // Append rows, packed like the first ones.
  grow({ rows, arrays, marks }) {
    for (const [name, text] of Object.entries(arrays)) {
      const before = this.arrays[name], added = Flight.unpacked(text);
      const all = new Float32Array(before.length + added.length);
      all.set(before);
      all.set(added, before.length);
      this.arrays[name] = all;
    }
    this.rows += rows;
    this.time = this.arrays.time;
    this.marks = marks;
  }

  get first() { return this.time[0]; }

  get last() { return this.time[this.rows - 1]; }

  // Logs of real flights have no CG, object mass or contact force.
  has(name) { return name in this.arrays; }

  width(name) { return this.arrays[name].length / this.rows; }

  // Row `row` of the array `name`, flat.
  at(name, row) {
    const width = this.width(name);
    return Array.from(this.arrays[name].subarray(row * width, (row + 1) * width));
  }

  // Element `k` of that row.
  get(name, row, k) { return this.arrays[name][row * this.width(name) + k]; }

  error(row, k) { return this.arrays.target[3 * row + k] - this.arrays.position[3 * row + k]; }

  push(row, drone) {
    const force = this.arrays.contact_force, k = row * this.width('contact_force') + 3 * drone;
    return Math.hypot(force[k], force[k + 1], force[k + 2]);
  }

  largest(name) { return this.arrays[name].reduce((most, value) => Math.max(most, Math.abs(value)), 1e-6); }

  largestContact() {
    let most = 1e-6;
    for (let row = 0; row < this.rows; row++) {
      this.plant.drones.forEach((_, drone) => { most = Math.max(most, this.push(row, drone)); });
    }
    return most;
  }

  // The leader is 0, followers are 1, 2 ... in order.
  place(drone) {
    const { leader } = this.plant;
    return drone === leader ? 0 : drone + (drone < leader);
  }

  // Name of the colour of drone number `drone` in the scene and in the plots.
  colour(drone) { return `drone-${this.place(drone) % 6}`; }

  dash(drone) { return this.place(drone) === 0 ? [5, 3] : this.place(drone) > 5 ? [2, 2] : []; }

  bounds() {
    const low = [Infinity, Infinity, Infinity], high = low.map((v) => -v);
    for (const values of [this.arrays.position, this.arrays.target]) {
      for (let k = 0, axis = 0; k < values.length; k++, axis = (axis + 1) % 3) {
        if (values[k] < low[axis]) low[axis] = values[k];
        if (values[k] > high[axis]) high[axis] = values[k];
      }
    }
    return { low, high };
  }

  // Up to 200 positions of the object and as many targets.
  places() {
    const every = Math.ceil(this.rows / 200), found = [];
    for (let row = 0; row < this.rows; row += every) found.push(this.at('position', row), this.at('target', row));
    return found;
  }

  // Rows of the drawn path, at least `step` metres apart; beyond 2000 rows `step` doubles.
  trail() {
    const { position: p } = this.arrays;
    const far = (a, b) => Math.hypot(...[0, 1, 2].map((axis) => p[3 * a + axis] - p[3 * b + axis]));
    const thin = (kept, row) => { if (far(kept[kept.length - 1], row) >= this.step) kept.push(row); return kept; };
    for (; this.seen < this.rows; this.seen++) {
      thin(this.kept, this.seen);
      if (this.kept.length > 2000) {
        this.step *= 2;
        this.kept = this.kept.reduce(thin, [0]);
      }
    }
    return this.kept;
  }

  // The row whose time is nearest.
  rowAt(time) {
    let low = 0, high = this.rows - 1;
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (this.time[middle] <= time) low = middle; else high = middle - 1;
    }
    return low + 1 < this.rows && this.time[low + 1] - time < time - this.time[low] ? low + 1 : low;
  }

  // The last mark of `kind` up to `time`.
  markAt(kind, time) { return this.marks.filter((mark) => mark.kind === kind && mark.time <= time + 1e-3).pop(); }
}
