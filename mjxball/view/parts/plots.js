// Time plots: lines over time with a cursor; click or drag to seek.
const LEFT = 54, RIGHT = 8, TOP = 6, BOTTOM = 18;
const LEAST = 1e-3;  // smallest y-range in the plot's unit, so that rounding errors do not look like motion

// About `count` round numbers between low and high, at least two, each with its text.
function ticks(low, high, count) {
  const raw = (high - low) / count, power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((k) => k * power).find((k) => k >= raw * 0.999);
  const found = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) found.push(k * step);
  return found.length > 1 || count > 10 ? found.map((v) => [v, fixed(v, step)]) : ticks(low, high, 2 * count);
}

// `value` with as many decimals as `step`.
function fixed(value, step) {
  const text = value.toFixed(clamp(Math.ceil(-Math.log10(step) - 1e-9), 0, 9));
  return (+text ? text : text.replace('-', '')).replace('-', '−');
}

// A positive number with three significant digits.
const short = (value) => String(+value.toPrecision(3));

// An element with text, which is never interpreted as HTML.
function element(kind, text = '', className = '') {
  const made = document.createElement(kind);
  made.textContent = text;
  made.className = className;
  return made;
}

function swatch(name) {
  const made = element('i', '', 'swatch');
  made.style.background = `var(--${name})`;
  return made;
}

class Plot {
  // series: [{ name, colour, value, dash }], where value(row) is a number. `peers`: plots of the same kind, one per
  // flight, which share a y-range: that of the visible rows, unless it is pinned.
  constructor(parent, { title, unit, series }, flight, peers, player) {
    Object.assign(this, { series, flight, peers });
    const block = element('div', '', 'plot'), head = element('h3', `${title} `), legend = element('div', '', 'legend');
    this.pin = element('button', 'pin', 'pin');
    this.pin.title = 'keep this y-range';
    this.pin.onclick = () => {
      const pinned = !this.pinned;
      peers.forEach((plot) => plot.keep(pinned));
      player.draw();
    };
    head.append(element('small', `[${unit}]`));
    this.canvas = element('canvas');
    block.append(this.pin, head, legend, this.canvas);
    parent.append(block);
    this.readouts = series.map(({ name, colour: its }) => {
      const label = element('span'), value = element('b');
      label.append(swatch(its), `${name} `, value);
      legend.append(label);
      return value;
    });
    peers.push(this);
    this.keep(false);
    const move = (event) => {
      if (event.type === 'pointermove' && !event.buttons) return;
      const box = this.canvas.getBoundingClientRect();
      const share = (event.clientX - box.left - LEFT) / (box.width - LEFT - RIGHT);
      player.seek(this.from + clamp(share, 0, 1) * (this.to - this.from));
    };
    this.canvas.addEventListener('pointerdown', move);
    this.canvas.addEventListener('pointermove', move);
  }

  keep(pinned) {
    this.pinned = pinned;
    this.pin.setAttribute('aria-pressed', pinned);
  }

  // Show the time from `from` to `to` [s].
  span(from, to) {
    [this.from, this.to] = [from, to];
    const { time, rows } = this.flight;
    // One more row on each side, so that lines reach the edges.
    let first = this.flight.rowAt(from), last = this.flight.rowAt(to);
    if (time[first] < from && first < last) first += 1;
    if (time[last] > to && first < last) last -= 1;
    this.rows = [Math.max(0, first - 1), Math.min(rows - 1, last + 1)];
    [this.least, this.most] = this.extent(first, last);
  }

  // Lowest and highest value from row `first` to row `last`.
  extent(first, last) {
    let low = Infinity, high = -Infinity;
    for (const { value } of this.series) {
      for (let row = first; row <= last; row++) {
        const v = value(row);
        if (v < low) low = v;
        if (v > high) high = v;
      }
    }
    return [low, high];
  }

  // Set the y-range; to be called after `span` of all peers.
  range() {
    if (this.pinned) return;
    const low = Math.min(...this.peers.map((plot) => plot.least));
    const high = Math.max(...this.peers.map((plot) => plot.most));
    const size = Math.max(Math.abs(low), Math.abs(high));
    const margin = Math.max(0.06 * (high - low), (LEAST - high + low) / 2, 1e-3 * size);
    [this.low, this.high] = [low - margin, high + margin];
  }

  // Draw the line of `value`; rows on the same pixel are reduced to their lowest and highest value.
  trace(c, value, x, y, ratio) {
    let place, low, high;
    const end = () => { c.lineTo(place, y(low)); if (high !== low) c.lineTo(place, y(high)); };
    c.beginPath();
    for (let row = this.rows[0]; row <= this.rows[1]; row++) {
      const v = value(row), here = Math.round(x(this.flight.time[row]) * ratio) / ratio;
      if (here === place) {
        if (v < low) low = v;
        if (v > high) high = v;
        continue;
      }
      if (place !== undefined) end();
      [place, low, high] = [here, v, v];
    }
    end();
    c.stroke();
  }

  // A picture of the lines, redrawn only if the canvas size, span or range changes.
  still(width, height, ratio) {
    const picture = document.createElement('canvas');
    [picture.width, picture.height] = [Math.round(width * ratio), Math.round(height * ratio)];
    const c = picture.getContext('2d'), { low, high, from, to } = this;
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    this.x = (t) => LEFT + (width - LEFT - RIGHT) * (t - from) / (to - from);
    const y = (v) => TOP + (height - TOP - BOTTOM) * (high - v) / (high - low);
    c.font = '11px system-ui, sans-serif';
    c.fillStyle = colour('soft');
    c.strokeStyle = colour('grid');
    c.textAlign = 'right';
    c.textBaseline = 'middle';
    for (const [v, text] of ticks(low, high, 3)) {
      c.beginPath(); c.moveTo(LEFT, y(v)); c.lineTo(width - RIGHT, y(v)); c.stroke();
      c.fillText(text, LEFT - 6, y(v));
    }
    c.textAlign = 'center';
    const marks = ticks(from, to, Math.max(2, width / 90));
    marks.forEach(([t, text], k) => {
      c.fillText(text + (k === marks.length - 1 ? ' s' : ''), Math.min(this.x(t), width - 14), height - 7);
    });
    c.beginPath(); c.rect(LEFT, 0, width - LEFT - RIGHT, height); c.clip();
    const phasesFirst = [...this.flight.marks].sort((a, b) => (b.kind === 'phase') - (a.kind === 'phase'));
    for (const { time, kind, level } of phasesFirst) {
      c.strokeStyle = colour(kind === 'phase' ? 'line' : level || 'bad');
      c.setLineDash(kind === 'phase' ? [2, 3] : []);
      c.beginPath(); c.moveTo(this.x(time), TOP); c.lineTo(this.x(time), height - BOTTOM); c.stroke();
    }
    c.lineWidth = 1.5;
    c.lineJoin = 'bevel';
    for (const { value, colour: its, dash, units } of this.series) {
      if (units) continue;
      c.strokeStyle = colour(its);
      c.setLineDash(dash || []);
      this.trace(c, value, this.x, y, ratio);
    }
    return picture;
  }

  draw(now) {
    const { canvas, flight } = this, ratio = window.devicePixelRatio || 1;
    const { width, height, top, bottom } = canvas.getBoundingClientRect();
    if (!width || bottom < 0 || top > window.innerHeight) return;  // scrolled away
    const { from, to, low, high } = this, { rows, marks } = flight;
    const of = String([width, height, ratio, from, to, low, high, rows, marks.length, colour('ink')]);
    if (this.of !== of) {
      this.of = of;
      this.picture = this.still(width, height, ratio);
      [canvas.width, canvas.height] = [this.picture.width, this.picture.height];
    }
    const c = canvas.getContext('2d'), x = this.x(clamp(now, this.from, this.to));
    c.setTransform(1, 0, 0, 1, 0, 0);
    c.clearRect(0, 0, canvas.width, canvas.height);
    c.drawImage(this.picture, 0, 0);
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    c.strokeStyle = colour('ink');
    c.beginPath(); c.moveTo(x, TOP); c.lineTo(x, height - BOTTOM); c.stroke();
  }

  // Update the values in the legend. To be called after all drawing, because text changes cause a new layout.
  read(row) {
    const step = Math.max(1e-4, 10 ** (Math.floor(Math.log10(this.high - this.low)) - 3));
    this.series.forEach(({ value, units }, k) => {
      this.readouts[k].textContent = units ? '' : fixed(value(row), step);
    });
  }
}

// Many values in [-1, 1] over time, each as a row of colour: red is positive, blue negative.
class Strips extends Plot {
  extent() { return [0, this.series[0].units]; }

  still(width, height, ratio) {
    const [{ units, array }] = this.series, { flight, from, to } = this;
    const picture = super.still(width, height, ratio), c = picture.getContext('2d');
    const wide = Math.ceil(width - LEFT - RIGHT), image = new ImageData(wide, units), values = flight.arrays[array];
    for (let x = 0; x < wide; x++) {
      const row = flight.rowAt(from + (to - from) * x / wide);
      for (let unit = 0; unit < units; unit++) {
        const value = values[row * units + unit], shade = 235 * (1 - Math.min(1, Math.abs(value)));
        const pixel = [value > 0 ? 235 : shade, shade, value > 0 ? shade : 235, 255];
        image.data.set(pixel, 4 * (x + wide * (units - 1 - unit)));
      }
    }
    const small = document.createElement('canvas');
    [small.width, small.height] = [wide, units];
    small.getContext('2d').putImageData(image, 0, 0);
    c.imageSmoothingEnabled = false;
    c.drawImage(small, LEFT, TOP, wide, height - TOP - BOTTOM);
    return picture;
  }
}
