'use strict';
// Space: vectors [x, y, z], quaternions [w, x, y, z], and a camera that orbits a point.
const add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
const sub = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const times = (s, a) => [s * a[0], s * a[1], s * a[2]];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const length = (a) => Math.sqrt(dot(a, a));

function rotate([w, x, y, z], v) {
  const axis = [x, y, z], t = times(2, cross(axis, v));
  return add(add(v, times(w, t)), cross(axis, t));
}

// Unit vectors of a view: towards the eye, to the right, up.
function axes({ azimuth, elevation }) {
  const ce = Math.cos(elevation), se = Math.sin(elevation), ca = Math.cos(azimuth), sa = Math.sin(azimuth);
  return { back: [ce * ca, ce * sa, se], right: [-sa, ca, 0], up: [-se * ca, -se * sa, ce] };
}

class Camera {
  constructor(target, distance) {
    this.home = { target, distance, azimuth: -1.15, elevation: 0.24 };
    Object.assign(this, this.home);
  }

  reset() { Object.assign(this, this.home); }

  turn(dx, dy) {
    this.azimuth -= 0.008 * dx;
    this.elevation = Math.max(-0.3, Math.min(1.5, this.elevation + 0.008 * dy));
  }

  zoom(factor) { this.distance = Math.max(0.3, Math.min(40, this.distance * factor)); }

  // Distance from which all `points`, given from the target, and what lies flat within `around` of each are seen at home.
  whole(points, around) {
    const { back, right, up } = axes(this.home);
    return Math.max(...points.map((p) => dot(p, back)
      + Math.max(2.6 * (Math.abs(dot(p, right)) + around), 3.4 * (Math.abs(dot(p, up)) + 0.4 * around))));
  }

  // Call once for each picture of `width` x `height` pixels.
  aim(width, height) {
    Object.assign(this, axes(this));
    this.place = add(this.target, times(this.distance, this.back));
    this.focal = 1.25 * Math.min(width, 1.3 * height);
    this.centre = [width / 2, height / 2];
  }

  // [x, y] in pixels and the depth in metres; depth below 0.05 means behind the camera.
  project(point) {
    const from = sub(point, this.place), depth = -dot(from, this.back);
    const size = this.focal / Math.max(depth, 0.05);
    return [this.centre[0] + size * dot(from, this.right), this.centre[1] - size * dot(from, this.up), depth];
  }
}
