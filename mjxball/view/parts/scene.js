// The scene: faces, lines and arrows, sorted by depth and drawn on a plain 2D canvas.
const COLOURS = {
  leader: '#2563a8', goal: '#2f9e44', cg: '#e0a800', thrust: '#0c8599', contact: '#c2255c',
  weight: '#868e96', path: '#8fa1b3',
};
// Of several followers, one after the other.
const FOLLOWERS = ['#d9730d', '#9c36b5', '#0ca678', '#e03131', '#7a5c3e', '#66a80f', '#495057', '#f06595'];
const LIGHT = [0.36, -0.48, 0.8];

function shaded(colour, light, alpha) {
  const mix = [1, 3, 5].map((k) => Math.round(parseInt(colour.slice(k, k + 2), 16) * (0.62 + 0.38 * light)));
  return `rgba(${mix.join(',')},${alpha})`;
}

class Scene {
  constructor(canvas, flight) {
    this.canvas = canvas;
    this.context = canvas.getContext('2d');
    this.flight = flight;
    this.shown = { thrust: true, contact: flight.has('contact_force'), weight: flight.has('object_mass'), path: true };
    this.camera = new Camera([0, 0, 0], 1);
    this.fit();
    // Arrows: this long [m] for the largest of its kind; of a flight that goes on, for the largest that there can be.
    this.reach = {
      thrust: 0.3 / (flight.plant.thrust || flight.largest('thrust')),
      contact: flight.has('contact_force') ? 0.4 / flight.largestContact() : 0,
    };
  }

  // Put the camera where all of the flight is seen, but leave how somebody has turned and zoomed.
  fit() {
    const { low, high } = this.flight.bounds(), { camera } = this, zoomed = camera.distance / camera.home.distance;
    this.middle = times(0.5, add(low, high));
    this.floor = Math.min(low[2] - 0.25, -0.25);
    const places = this.flight.places().map((place) => sub(place, this.middle));
    const rig = Math.max(...this.flight.plant.drones.map(({ mount, arm }) => length(mount) + 1.6 * arm));
    Object.assign(camera.home, { target: this.middle, distance: camera.whole(places, rig) });
    Object.assign(camera, { target: this.middle, distance: zoomed * camera.home.distance });
  }

  draw(row) {
    const { canvas, context, camera } = this, ratio = window.devicePixelRatio || 1;
    const width = canvas.clientWidth, height = canvas.clientHeight;
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    const sky = context.createLinearGradient(0, 0, 0, height);
    sky.addColorStop(0, '#ffffff');
    sky.addColorStop(1, '#e9eef3');
    context.fillStyle = sky;
    context.fillRect(0, 0, width, height);
    camera.aim(width, height);
    this.parts = [];
    this.ground();
    this.paint();
    this.goal(row);
    if (this.shown.path) this.path(row);
    this.team(row);
    this.paint();
    this.arrows(row);
    if (this.flight.has('cg_offset')) this.centreOfGravity(row);
    this.paint();
  }

  face(points, colour, alpha = 1, edge = 'rgba(30,40,50,0.35)') {
    const normal = cross(sub(points[1], points[0]), sub(points[2], points[0])), size = length(normal) || 1;
    this.parts.push({ points, fill: shaded(colour, Math.abs(dot(normal, LIGHT)) / size, alpha), edge });
  }

  line(points, colour, width = 1, dash = []) { this.parts.push({ points, line: colour, width, dash }); }

  ball(centre, radius, colour) { this.parts.push({ points: [centre], radius, colour }); }

  paint() {
    for (const part of this.parts) {
      part.seen = part.points.map((point) => this.camera.project(point));
      part.depth = part.seen.reduce((sum, p) => sum + p[2], 0) / part.seen.length;
    }
    this.parts.sort((a, b) => b.depth - a.depth);
    for (const part of this.parts) if (part.seen.every((p) => p[2] > 0.05)) this.paintOne(part);
    this.parts = [];
  }

  paintOne(part) {
    const c = this.context;
    c.beginPath();
    if (part.radius) {
      const [x, y, depth] = part.seen[0], r = Math.max(2.5, part.radius * this.camera.focal / depth);
      const glow = c.createRadialGradient(x - 0.35 * r, y - 0.35 * r, 0.1 * r, x, y, r);
      glow.addColorStop(0, shaded(part.colour, 1.9, 1));
      glow.addColorStop(1, shaded(part.colour, 0.55, 1));
      c.arc(x, y, r, 0, 2 * Math.PI);
      c.fillStyle = glow;
      c.fill();
      return;
    }
    part.seen.forEach(([x, y], k) => (k ? c.lineTo(x, y) : c.moveTo(x, y)));
    if (part.fill) {
      c.closePath();
      c.fillStyle = part.fill;
      c.fill();
    }
    c.setLineDash(part.dash || []);
    c.strokeStyle = part.line || part.edge;
    c.lineWidth = part.width || 0.8;
    c.stroke();
    c.setLineDash([]);
  }

  ground() {
    const step = 0.5, z = this.floor, [cx, cy] = this.middle.map((v) => Math.round(v / step) * step), reach = 2.5;
    for (let k = -reach; k <= reach; k += step) {
      this.line([[cx + k, cy - reach, z], [cx + k, cy + reach, z]], '#d5dce3');
      this.line([[cx - reach, cy + k, z], [cx + reach, cy + k, z]], '#d5dce3');
    }
    const base = [cx - reach, cy - reach, z];
    ['x', 'y', 'z'].forEach((name, k) => {
      const tip = [...base];
      tip[k] += 0.5;
      this.line([base, tip], ['#c92a2a', '#2b8a3e', '#1864ab'][k], 2);
    });
  }

  goal(row) {
    const goal = this.flight.at('target', row), foot = [goal[0], goal[1], this.floor];
    this.line([goal, foot], COLOURS.goal, 1, [4, 4]);
    this.ball(goal, 0.03, COLOURS.goal);
    for (const [u, v] of [[0, 1], [1, 2], [0, 2]]) {
      const ring = [];
      for (let k = 0; k <= 32; k++) {
        const point = [...goal];
        point[u] += 0.08 * Math.cos(k * Math.PI / 16);
        point[v] += 0.08 * Math.sin(k * Math.PI / 16);
        ring.push(point);
      }
      this.line(ring, COLOURS.goal, 1.2);
    }
  }

  path(row) {
    const points = [], every = Math.max(1, Math.floor(row / 600));
    for (let k = 0; k < row; k += every) points.push(this.flight.at('position', k));
    points.push(this.flight.at('position', row));
    for (let k = 0; k + 1 < points.length; k += 6) this.line(points.slice(k, k + 7), COLOURS.path, 1.6);
    const here = this.flight.at('position', row);
    this.line([here, [here[0], here[1], this.floor]], '#c3ccd5', 1, [2, 5]);
  }

  team(row) {
    const { flight } = this, { size, drones, disc, axes, rim } = flight.plant, plane = axes.length === 2;
    const place = flight.at('position', row), turn = flight.at('quaternion', row);
    const world = (point) => add(place, rotate(turn, point));
    const half = size.map((edge, k) => (plane && k === 2 ? 0.2 : 1) * edge / 2);
    if (disc) this.disc(world, [0, 0, 0], half[0], '#c8b07a', 0.4);
    else this.box(world, [0, 0, 0], half, '#c8b07a', 0.4);
    if (plane && rim) this.line(this.circle(world, [0, 0, half[2]], rim), '#8d6e28', 1.5);
    drones.forEach(({ mount, rotors, arm }, drone) => {
      const colour = flight.colour(drone), hub = 0.18 * arm, high = 0.028;
      if (drones.length > 2) this.line([world([0, 0, 0]), world(mount)], '#a08a55', 3);
      this.box(world, mount, [hub * 1.3, hub * 1.3, 0.022], colour, 1);
      rotors.forEach(([x, y]) => {
        const tip = add(mount, [x, y, high]);
        this.line([world(add(mount, [hub * x, hub * y, 0])), world(tip)], shaded(colour, 0, 1), 3);
        this.disc(world, tip, 0.6 * arm, colour, 0.42);
      });
    });
  }

  circle(world, centre, radius) {
    const found = [];
    for (let k = 0; k <= 24; k++) {
      const angle = k * Math.PI / 12;
      found.push(world(add(centre, [radius * Math.cos(angle), radius * Math.sin(angle), 0])));
    }
    return found;
  }

  disc(world, centre, radius, colour, alpha) { this.face(this.circle(world, centre, radius), colour, alpha); }

  // Where the object's CG is, in body axes.
  offset(row) {
    const offset = [0, 0, 0], found = this.flight.at('cg_offset', row);
    this.flight.plant.axes.forEach((axis, k) => { offset[axis] = found[k]; });
    return offset;
  }

  // Drawn last: it is inside the object.
  centreOfGravity(row) {
    const { flight } = this, turned = rotate(flight.at('quaternion', row), this.offset(row));
    this.ball(add(flight.at('position', row), turned), flight.plant.ball, COLOURS.cg);
  }

  box(world, centre, half, colour, alpha) {
    for (let k = 0; k < 3; k++) {
      for (const side of [-1, 1]) {
        const corners = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(([u, v]) => {
          const point = [0, 0, 0];
          point[k] = side * half[k];
          point[(k + 1) % 3] = u * half[(k + 1) % 3];
          point[(k + 2) % 3] = v * half[(k + 2) % 3];
          return world(add(centre, point));
        });
        this.face(corners, colour, alpha);
      }
    }
  }

  arrows(row) {
    const { flight } = this, place = flight.at('position', row), turn = flight.at('quaternion', row);
    const thrust = flight.at('thrust', row), force = this.shown.contact ? flight.at('contact_force', row) : [];
    flight.plant.drones.forEach(({ mount }, drone) => {
      const from = add(place, rotate(turn, mount));
      if (this.shown.thrust) this.arrow(from, rotate(turn, [0, 0, this.reach.thrust * thrust[drone]]), COLOURS.thrust);
      if (!this.shown.contact) return;
      const push = times(this.reach.contact, force.slice(3 * drone, 3 * drone + 3));
      this.arrow(from, rotate(turn, push), COLOURS.contact);
    });
    if (!this.shown.weight) return;
    const weight = flight.plant.gravity * flight.at('object_mass', row)[0];
    this.arrow(add(place, rotate(turn, this.offset(row))), [0, 0, -this.reach.contact * weight], COLOURS.weight);
  }

  arrow(from, along, colour) {
    const c = this.context, [x, y, near] = this.camera.project(from), [u, v, far] = this.camera.project(add(from, along));
    const size = Math.hypot(u - x, v - y), head = Math.min(11, 0.6 * size);
    if (near < 0.05 || far < 0.05 || size < 2) return;
    const [dx, dy] = [(u - x) / size, (v - y) / size];
    c.strokeStyle = c.fillStyle = colour;
    c.lineWidth = 3;
    c.beginPath();
    c.moveTo(x, y);
    c.lineTo(u - head * dx, v - head * dy);
    c.stroke();
    c.beginPath();
    c.moveTo(u, v);
    c.lineTo(u - head * dx - 0.5 * head * dy, v - head * dy + 0.5 * head * dx);
    c.lineTo(u - head * dx + 0.5 * head * dy, v - head * dy - 0.5 * head * dx);
    c.fill();
  }
}
