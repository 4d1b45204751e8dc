// The scene: faces, lines and arrows, sorted by depth and drawn on a plain 2D canvas.
const LIGHT = [0.36, -0.48, 0.8];
// Lengths of the arrows of the largest forces, and radius of the goal's ring [m]. They shrink with rigs whose radius is
// below RIG [m].
const THRUST = 0.3, CONTACT = 0.4, GOAL = 0.1, RIG = 0.36;

// Value of a named colour of the style sheet in the current theme, cached.
const palette = new Map();
function colour(name) {
  if (!palette.has(name)) {
    const probe = document.getElementById('probe');
    probe.style.color = '';
    probe.style.color = `var(--${name})`;
    palette.set(name, getComputedStyle(probe).color);
  }
  return palette.get(name);
}

function shaded(name, light, alpha) {
  const mix = colour(name).match(/[\d.]+/g).slice(0, 3).map((value) => Math.round(value * (0.62 + 0.38 * light)));
  return `rgba(${mix.join(',')},${alpha})`;
}

// Common camera distance, floor and arrow scales of several flights.
function surroundings(flights, camera) {
  const bounds = flights.map((flight) => flight.bounds());
  const low = [0, 1, 2].map((k) => Math.min(...bounds.map((one) => one.low[k])));
  const high = [0, 1, 2].map((k) => Math.max(...bounds.map((one) => one.high[k])));
  const middle = times(0.5, add(low, high));
  const drones = flights.flatMap(({ plant }) => plant.drones);
  const rig = Math.max(...drones.map(({ mount, arm }) => length(mount) + 1.6 * arm));
  const places = flights.flatMap((flight) => flight.places()).map((place) => sub(place, middle));
  const size = Math.min(1, rig / RIG), arrows = places.map((place) => add(place, [0, 0, size * THRUST]));
  const touching = flights.filter((flight) => flight.has('contact_force'));
  return {
    middle,
    floor: Math.min(low[2] - 0.25, -0.25),
    extent: Math.max(high[0] - low[0], high[1] - low[1]) / 2 + 0.5,
    goal: size * GOAL,
    distance: camera.whole([...places, ...arrows], rig),
    // [m/N]; in a live flight from the largest possible thrust.
    reach: {
      thrust: size * THRUST / Math.max(...flights.map((flight) => flight.plant.thrust || flight.largest('thrust'))),
      contact: touching.length ? size * CONTACT / Math.max(...touching.map((flight) => flight.largestContact())) : 0,
    },
  };
}

class Scene {
  // `shown`: which parts are drawn. All scenes share it and the camera.
  constructor(canvas, flight, camera, shown) {
    Object.assign(this, { canvas, flight, camera, shown, context: canvas.getContext('2d') });
  }

  has(kind) { return this.shown[kind] && this.flight.has(NEEDED[kind]); }

  // The point that the camera orbits.
  target(row) { return this.camera.follow ? this.flight.at('position', row) : this.world.middle; }

  draw(row) {
    const { canvas, context } = this, ratio = window.devicePixelRatio || 1;
    const width = canvas.clientWidth, height = canvas.clientHeight;
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    const sky = context.createLinearGradient(0, 0, 0, height);
    sky.addColorStop(0, colour('sky-high'));
    sky.addColorStop(1, colour('sky-low'));
    context.fillStyle = sky;
    context.fillRect(0, 0, width, height);
    this.lens = new Lens(this.camera, this.target(row), width, height);
    this.parts = [];
    this.ground();
    this.paint();
    // Painted before the team, so that goal and path never hide it.
    this.goal(row);
    if (this.has('path')) this.path(row);
    this.paint();
    this.team(row);
    this.paint();
    this.arrows(row);
    if (this.flight.has('cg_offset')) this.centreOfGravity(row);
    this.paint();
    this.scales(row, height);
  }

  face(points, name, alpha = 1) {
    const normal = cross(sub(points[1], points[0]), sub(points[2], points[0])), size = length(normal) || 1;
    this.parts.push({ points, fill: shaded(name, Math.abs(dot(normal, LIGHT)) / size, alpha), edge: colour('edge') });
  }

  line(points, style, width = 1, dash = []) { this.parts.push({ points, line: style, width, dash }); }

  ball(centre, radius, name) { this.parts.push({ points: [centre], radius, name }); }

  paint() {
    for (const part of this.parts) {
      part.seen = part.points.map((point) => this.lens.project(point));
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
      const [x, y, depth] = part.seen[0], r = Math.max(2.5, part.radius * this.lens.focal / depth);
      const glow = c.createRadialGradient(x - 0.35 * r, y - 0.35 * r, 0.1 * r, x, y, r);
      glow.addColorStop(0, shaded(part.name, 1.9, 1));
      glow.addColorStop(1, shaded(part.name, 0.55, 1));
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
    const { floor, extent, middle } = this.world, step = [0.5, 1, 2, 5, 10, 20, 50].find((k) => 5 * k >= extent) || 100;
    const [cx, cy] = middle.map((v) => Math.round(v / step) * step), reach = 5 * step;
    for (let k = -reach; k <= reach; k += step) {
      this.line([[cx + k, cy - reach, floor], [cx + k, cy + reach, floor]], colour('grid'));
      this.line([[cx - reach, cy + k, floor], [cx + reach, cy + k, floor]], colour('grid'));
    }
    const base = [cx - reach, cy - reach, floor];
    ['x', 'y', 'z'].forEach((name, k) => {
      const tip = [...base];
      tip[k] += step;
      this.line([base, tip], colour(name), 2);
    });
  }

  // A thin ring that faces the camera, with four outward strokes, and a dashed line down to the floor.
  goal(row) {
    const goal = this.flight.at('target', row), { right, up } = this.lens, radius = this.world.goal;
    const around = (share, angle) => add(goal, times(share * radius,
      add(times(Math.cos(angle), right), times(Math.sin(angle), up))));
    this.line([goal, [goal[0], goal[1], this.world.floor]], colour('goal'), 1, [4, 4]);
    this.line(Array.from({ length: 33 }, (_, k) => around(1, k * Math.PI / 16)), colour('goal'), 1.5);
    for (const angle of [0, 1, 2, 3].map((k) => k * Math.PI / 2)) {
      this.line([around(0.8, angle), around(1.4, angle)], colour('goal'), 1.5);
    }
  }

  path(row) {
    const points = [];
    for (const k of this.flight.trail()) {
      if (k >= row) break;
      points.push(this.flight.at('position', k));
    }
    const here = this.flight.at('position', row);
    points.push(here);
    for (let k = 0; k + 1 < points.length; k += 12) this.line(points.slice(k, k + 13), colour('path'), 1.6);
    this.line([here, [here[0], here[1], this.world.floor]], colour('path'), 1, [2, 5]);
  }

  team(row) {
    const { flight } = this, { size, drones, disc, axes: along, rim } = flight.plant, plane = along.length === 2;
    const place = flight.at('position', row), turn = flight.at('quaternion', row);
    const world = (point) => add(place, rotate(turn, point));
    const half = size.map((edge, k) => (plane && k === 2 ? 0.2 : 1) * edge / 2);
    if (disc) this.disc(world, [0, 0, 0], half[0], 'object', 0.4);
    else this.box(world, [0, 0, 0], half, 'object', 0.4);
    if (plane && rim) this.line(this.circle(world, [0, 0, half[2]], rim), colour('rim'), 1.5);
    drones.forEach(({ mount, rotors, arm }, drone) => {
      const name = flight.colour(drone), hub = 0.18 * arm, high = 0.028;
      if (drones.length > 2) this.line([world([0, 0, 0]), world(mount)], colour('rim'), 3);
      this.box(world, mount, [hub * 1.3, hub * 1.3, 0.022], name, 1);
      rotors.forEach(([x, y]) => {
        const tip = add(mount, [x, y, high]);
        this.line([world(add(mount, [hub * x, hub * y, 0])), world(tip)], shaded(name, 0, 1), 3);
        this.disc(world, tip, 0.6 * arm, name, 0.42);
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

  disc(world, centre, radius, name, alpha) { this.face(this.circle(world, centre, radius), name, alpha); }

  // Offset of the object's CG in body axes [m].
  offset(row) {
    const offset = [0, 0, 0], found = this.flight.at('cg_offset', row);
    this.flight.plant.axes.forEach((axis, k) => { offset[axis] = found[k]; });
    return offset;
  }

  // Painted last, because it is inside the object.
  centreOfGravity(row) {
    const { flight } = this, turned = rotate(flight.at('quaternion', row), this.offset(row));
    this.ball(add(flight.at('position', row), turned), flight.plant.ball, 'cg');
  }

  box(world, centre, half, name, alpha) {
    for (let k = 0; k < 3; k++) {
      for (const side of [-1, 1]) {
        const corners = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(([u, v]) => {
          const point = [0, 0, 0];
          point[k] = side * half[k];
          point[(k + 1) % 3] = u * half[(k + 1) % 3];
          point[(k + 2) % 3] = v * half[(k + 2) % 3];
          return world(add(centre, point));
        });
        this.face(corners, name, alpha);
      }
    }
  }

  arrows(row) {
    const { flight, world: { reach } } = this, place = flight.at('position', row), turn = flight.at('quaternion', row);
    const thrust = flight.at('thrust', row), force = this.has('contact') ? flight.at('contact_force', row) : [];
    flight.plant.drones.forEach(({ mount }, drone) => {
      const from = add(place, rotate(turn, mount));
      if (this.has('thrust')) this.arrow(from, rotate(turn, [0, 0, reach.thrust * thrust[drone]]), 'thrust');
      if (!this.has('contact')) return;
      const push = times(reach.contact, force.slice(3 * drone, 3 * drone + 3));
      this.arrow(from, rotate(turn, push), 'contact');
    });
    if (!this.has('weight')) return;
    const weight = flight.plant.gravity * flight.at('object_mass', row)[0];
    this.arrow(add(place, rotate(turn, this.offset(row))), [0, 0, -reach.contact * weight], 'weight');
  }

  arrow(from, along, name) {
    const [x, y, near] = this.lens.project(from), [u, v, far] = this.lens.project(add(from, along));
    if (near > 0.05 && far > 0.05) this.strokeArrow(x, y, u, v, name);
  }

  strokeArrow(x, y, u, v, name) {
    const c = this.context, size = Math.hypot(u - x, v - y), head = Math.min(11, 0.6 * size);
    if (size < 2) return;
    const [dx, dy] = [(u - x) / size, (v - y) / size];
    c.strokeStyle = c.fillStyle = colour(name);
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

  // Scale bars: for each kind of arrow a round force, with its length on screen at the load's depth.
  bars(row) {
    const depth = this.lens.project(this.flight.at('position', row))[2], { reach } = this.world;
    if (depth < 0.05) return [];
    const bar = (name, metres, text) => {
      // Rounded at the common camera distance, so that all scenes show the same force.
      const most = 80 * this.camera.distance / this.lens.focal / metres, power = 10 ** Math.floor(Math.log10(most));
      const value = [5, 2, 1].map((k) => k * power).find((k) => k <= most);
      return { name, value, pixels: value * metres * this.lens.focal / depth, text: `${short(value)} ${text}` };
    };
    const pushed = ['contact', 'weight'].filter((kind) => this.has(kind));
    return [
      ...(this.has('thrust') ? [bar('thrust', reach.thrust, 'N thrust')] : []),
      ...(pushed.length ? [bar(pushed[0], reach.contact, `N ${pushed.join(', ')}`)] : []),
      bar('soft', 0.01, 'cm'),
    ];
  }

  scales(row, height) {
    const c = this.context;
    c.font = '12px system-ui, sans-serif';
    c.textBaseline = 'middle';
    this.bars(row).reverse().forEach(({ name, pixels, text }, k) => {
      const y = height - 14 - 18 * k;
      if (name === 'soft') {
        c.fillStyle = colour(name);
        c.fillRect(10, y - 1, pixels, 2);
        for (const x of [10, 8 + pixels]) c.fillRect(x, y - 4, 2, 8);
      } else this.strokeArrow(10, y, 10 + pixels, y, name);
      c.fillStyle = colour('ink');
      c.fillText(text, 18 + pixels, y);
    });
  }
}
