// Time plots: lines over time with a cursor; click or drag to seek.
const LEFT = 46, RIGHT = 8, TOP = 6, BOTTOM = 18;

// About `count` round numbers between low and high, two at least.
function ticks(low, high, count) {
  const raw = (high - low) / count, power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((k) => k * power).find((k) => k >= raw * 0.999);
  const found = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) found.push(k * step);
  return found.length > 1 || count > 10 ? found : ticks(low, high, 2 * count);
}

const short = (value) => String(+value.toPrecision(3)).replace('-', '−');

// Names are text: nothing is written as HTML.
function element(kind, text = '') {
  const made = document.createElement(kind);
  made.textContent = text;
  return made;
}

function swatch(colour) {
  const made = element('i');
  made.className = 'swatch';
  made.style.background = colour;
  return made;
}

class Plot {
  // series: [{ name, colour, values, dash }]
  constructor(parent, title, unit, time, series, seek) {
    Object.assign(this, { time, series });
    const block = document.createElement('div');
    block.className = 'plot';
    const head = element('h2', `${title} `), legend = element('div');
    head.append(element('small', `[${unit}]`));
    legend.className = 'legend';
    this.canvas = element('canvas');
    block.append(head, legend, this.canvas);
    parent.append(block);
    this.readouts = series.map(({ name, colour }) => {
      const label = element('span'), value = element('b');
      label.append(swatch(colour), `${name} `, value);
      legend.append(label);
      return value;
    });
    this.range();
    this.span(time[0], time[time.length - 1]);
    const move = (event) => {
      if (event.type === 'pointermove' && !event.buttons) return;
      const box = this.canvas.getBoundingClientRect();
      const share = (event.clientX - box.left - LEFT) / (box.width - LEFT - RIGHT);
      seek(this.from + Math.max(0, Math.min(1, share)) * (this.to - this.from));
    };
    this.canvas.addEventListener('pointerdown', move);
    this.canvas.addEventListener('pointermove', move);
  }

  // The same lines, longer.
  grow(time, series) {
    Object.assign(this, { time, series, size: '' });
    this.range();
  }

  range() {
    let low = Infinity, high = -Infinity;
    for (const { values } of this.series) for (const v of values) { low = Math.min(low, v); high = Math.max(high, v); }
    const margin = Math.max(0.06 * (high - low), 1e-3 * Math.max(Math.abs(low), Math.abs(high)), 1e-6);
    [this.low, this.high] = [low - margin, high + margin];
  }

  // Show the time from `from` to `to` [s].
  span(from, to) { [this.from, this.to] = [from, to]; }

  // The lines are drawn once for each size of the canvas and each span.
  still(width, height, ratio) {
    const picture = document.createElement('canvas');
    [picture.width, picture.height] = [width * ratio, height * ratio];
    const c = picture.getContext('2d'), { time, low, high, from, to } = this;
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    this.x = (t) => LEFT + (width - LEFT - RIGHT) * (t - from) / (to - from);
    const y = (v) => TOP + (height - TOP - BOTTOM) * (high - v) / (high - low);
    c.font = '11px system-ui, sans-serif';
    c.fillStyle = '#5c6670';
    c.strokeStyle = '#e3e8ec';
    c.textAlign = 'right';
    c.textBaseline = 'middle';
    for (const v of ticks(low, high, 3)) {
      c.beginPath(); c.moveTo(LEFT, y(v)); c.lineTo(width - RIGHT, y(v)); c.stroke();
      c.fillText(short(v), LEFT - 6, y(v));
    }
    c.textAlign = 'center';
    const marks = ticks(from, to, Math.max(2, width / 90));
    marks.forEach((t, k) => c.fillText(short(t) + (k === marks.length - 1 ? ' s' : ''), Math.min(this.x(t), width - 14), height - 7));
    c.beginPath(); c.rect(LEFT, 0, width - LEFT - RIGHT, height); c.clip();
    c.lineWidth = 1.5;
    c.lineJoin = 'round';
    for (const { values, colour, dash } of this.series.filter(({ rows }) => !rows)) {
      c.strokeStyle = colour;
      c.setLineDash(dash || []);
      c.beginPath();
      for (let k = 0; k < time.length; k++) {
        if (time[k] >= from - 0.1 && time[k] <= to + 0.1) c.lineTo(this.x(time[k]), y(values[k]));
      }
      c.stroke();
    }
    return picture;
  }

  draw(row) {
    const { canvas } = this, ratio = window.devicePixelRatio || 1;
    const width = canvas.clientWidth, height = canvas.clientHeight;
    if (!width) return;
    const size = `${width} ${height} ${ratio} ${this.from} ${this.to}`;
    if (this.size !== size) {
      this.size = size;
      this.picture = this.still(width, height, ratio);
      [canvas.width, canvas.height] = [this.picture.width, this.picture.height];
    }
    const c = canvas.getContext('2d');
    c.setTransform(1, 0, 0, 1, 0, 0);
    c.clearRect(0, 0, canvas.width, canvas.height);
    c.drawImage(this.picture, 0, 0);
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    c.strokeStyle = '#1d2329';
    c.beginPath(); c.moveTo(this.x(this.time[row]), TOP); c.lineTo(this.x(this.time[row]), height - BOTTOM); c.stroke();
    this.series.forEach(({ values, rows }, k) => { this.readouts[k].textContent = rows ? '' : short(values[row]); });
  }
}

// Many values from -1 to 1 over time, one row of colour each: red is positive, blue negative.
class Strips extends Plot {
  range() { [this.low, this.high] = [0, this.series[0].rows]; }

  still(width, height, ratio) {
    const [{ rows, values }] = this.series, { time, from, to } = this;
    const picture = super.still(width, height, ratio), c = picture.getContext('2d');
    const tall = (height - TOP - BOTTOM) / rows, wide = Math.ceil(width - LEFT - RIGHT);
    let row = 0;
    for (let x = 0; x < wide; x++) {
      const now = from + (to - from) * x / wide;
      while (row < time.length - 1 && time[row + 1] <= now) row++;
      for (let unit = 0; unit < rows; unit++) {
        const value = values[row * rows + unit], shade = Math.round(235 * (1 - Math.min(1, Math.abs(value))));
        c.fillStyle = value > 0 ? `rgb(235 ${shade} ${shade})` : `rgb(${shade} ${shade} 235)`;
        c.fillRect(LEFT + x, TOP + (rows - 1 - unit) * tall, 1.5, tall + 0.5);
      }
    }
    return picture;
  }
}
