'use strict';
// Space: vectors [x, y, z], quaternions [w, x, y, z], and a camera that orbits a point.
const add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
const sub = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const times = (s, a) => [s * a[0], s * a[1], s * a[2]];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const length = (a) => Math.sqrt(dot(a, a));
const clamp = (value, low, high) => Math.max(low, Math.min(high, value));

function rotate([w, x, y, z], v) {
  const axis = [x, y, z], t = times(2, cross(axis, v));
  return add(add(v, times(w, t)), cross(axis, t));
}

// Unit vectors of a view: towards the camera, to the right, up.
function axes({ azimuth, elevation }) {
  const ce = Math.cos(elevation), se = Math.sin(elevation), ca = Math.cos(azimuth), sa = Math.sin(azimuth);
  return { back: [ce * ca, ce * sa, se], right: [-sa, ca, 0], up: [-se * ca, -se * sa, ce] };
}

// Camera of all scenes: it orbits a target that is moved by `pan`.
class Camera {
  constructor() {
    this.home = { azimuth: -1.15, elevation: 0.24, distance: 1, pan: [0, 0, 0] };
    this.follow = false;  // the rig is the target, else the middle of the flight
    this.reset();
  }

  reset() { Object.assign(this, this.home); }

  turn(dx, dy) {
    this.azimuth -= 0.008 * dx;
    this.elevation = clamp(this.elevation + 0.008 * dy, -0.3, 1.5);
  }

  // Pan by pixels over the focal length: points at the target's depth follow the pointer.
  slide(dx, dy) { this.pan = add(this.pan, this.across(-dx, -dy, this.distance)); }

  // Zoom so that the point at (dx, dy) from the centre, at the target's depth, stays in place.
  zoom(factor, dx = 0, dy = 0) {
    const before = this.distance;
    this.distance = clamp(before * factor, 0.3, 40);
    this.pan = add(this.pan, this.across(dx, dy, before - this.distance));
  }

  across(dx, dy, depth) {
    const { right, up } = axes(this);
    return add(times(dx * depth, right), times(-dy * depth, up));
  }

  // Distance at which the home view contains all `points`, relative to the target, and a horizontal disc of radius
  // `around` about each.
  whole(points, around) {
    const { back, right, up } = axes(this.home);
    return Math.max(...points.map((p) => dot(p, back)
      + Math.max(2.6 * (Math.abs(dot(p, right)) + around), 3.4 * (Math.abs(dot(p, up)) + 0.4 * around))));
  }
}

// Projection of a camera that looks at `target` onto a picture of `width` x `height` pixels.
class Lens {
  constructor(camera, target, width, height) {
    Object.assign(this, axes(camera));
    this.place = add(add(target, camera.pan), times(camera.distance, this.back));
    this.focal = 1.25 * Math.min(width, 1.3 * height);
    this.centre = [width / 2, height / 2];
  }

  // [x, y] [pixels] and depth [m] of a point; a depth below 0.05 means behind the camera.
  project(point) {
    const from = sub(point, this.place), depth = -dot(from, this.back);
    const size = this.focal / Math.max(depth, 0.05);
    return [this.centre[0] + size * dot(from, this.right), this.centre[1] - size * dot(from, this.up), depth];
  }
}
