// Keys, gestures and the theme, and the message of a browser that cannot draw.
const KEYS = {
  ' ': ['Space', 'play or pause', (player) => player.toggle()],
  ArrowLeft: ['←', '0.1 s back; with Shift 1 s', (player, shift) => step(player, shift ? -10 : -1)],
  ArrowRight: ['→', '0.1 s on; with Shift 1 s', (player, shift) => step(player, shift ? 10 : 1)],
  Home: ['Home', 'to the start', (player) => player.seek(-Infinity)],
  End: ['End', 'to the end', (player) => player.seek(Infinity)],
  f: ['f', 'follow the rig, or stop', (player) => player.follow(!player.camera.follow)],
  r: ['r', 'reset the view', (player) => { player.camera.reset(); player.draw(); }],
  d: ['d', 'dark or light', () => turnTheme()],
  '?': ['?', 'show or hide this list', () => turnHelp()],
};

// Move the clock by tenths of a second; adding 0.1 repeatedly would drift.
const step = (player, tenths) => player.seek(Math.round((player.now + tenths / 10) * 1e6) / 1e6);

const darkness = matchMedia('(prefers-color-scheme: dark)');
let dark = darkness.matches;

function setTheme(wanted) {
  dark = wanted;
  document.documentElement.style.colorScheme = dark ? 'dark' : 'light';
  palette.clear();
  document.dispatchEvent(new Event('theme'));
}

const turnTheme = () => setTheme(!dark);

function turnHelp() {
  const keys = document.getElementById('keys');
  if (keys.open) keys.close(); else keys.showModal();
}

// Keys control the player, unless a text field has the focus or a control was reached by Tab.
let tabbed = false;
document.addEventListener('pointerdown', () => { tabbed = false; }, true);

function keyed(event, player) {
  if (event.key === 'Tab') tabbed = true;
  if (event.ctrlKey || event.metaKey || event.altKey || !(event.key in KEYS)) return;
  const { target } = event, control = target.closest('select, button, input, textarea, [contenteditable]');
  const writes = control?.matches('textarea, [contenteditable], input:not([type=range], [type=checkbox])');
  const operated = tabbed && control && (event.key === ' ' || (control.matches('select') && event.key !== '?'));
  if (writes || operated || (document.getElementById('keys').open && event.key !== '?')) return;
  event.preventDefault();
  if (!tabbed) control?.blur();  // some browsers press a focused button when Space is released
  KEYS[event.key][2](player, event.shiftKey);
}

// Drag: turn; with Shift, the right button or two fingers: move. Wheel or two fingers: zoom where the pointer is.
function listen(scene, player) {
  const { canvas, camera } = scene, fingers = new Map();
  let slides = false;
  const pair = () => {
    const [a, b] = [...fingers.values()];
    return { apart: Math.hypot(a[0] - b[0], a[1] - b[1]), x: (a[0] + b[0]) / 2, y: (a[1] + b[1]) / 2 };
  };
  const slide = (dx, dy) => camera.slide(dx / scene.lens.focal, dy / scene.lens.focal);
  const zoom = (factor, x, y) => {
    const box = canvas.getBoundingClientRect(), { focal, centre } = scene.lens;
    camera.zoom(factor, (x - box.left - centre[0]) / focal, (y - box.top - centre[1]) / focal);
  };
  canvas.addEventListener('pointerdown', (event) => {
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
    slides = event.button === 2 || event.shiftKey;
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener('pointermove', (event) => {
    const last = fingers.get(event.pointerId);
    if (!last) return;
    const before = fingers.size === 2 && pair();
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
    const [dx, dy] = [event.clientX - last[0], event.clientY - last[1]];
    if (before) {
      const after = pair();
      slide(after.x - before.x, after.y - before.y);
      zoom(before.apart / Math.max(after.apart, 1), after.x, after.y);
    } else if (fingers.size === 1) (slides ? slide : (x, y) => camera.turn(x, y))(dx, dy);
    player.draw();
  });
  for (const name of ['pointerup', 'pointercancel']) {
    canvas.addEventListener(name, (event) => fingers.delete(event.pointerId));
  }
  canvas.addEventListener('contextmenu', (event) => event.preventDefault());
  canvas.addEventListener('wheel', (event) => {
    event.preventDefault();
    zoom(Math.exp(0.001 * event.deltaY), event.clientX, event.clientY);
    player.draw();
  }, { passive: false });
  canvas.addEventListener('dblclick', () => { camera.reset(); player.draw(); });
}

// Whether this browser can draw; if not, the page says so.
function canDraw() {
  if (document.createElement('canvas').getContext('2d')) return true;
  document.querySelector('main').replaceChildren(element('p',
    'This browser cannot draw: its canvas is turned off. Allow it for this page, or open the page in another browser.',
    'sorry'));
  return false;
}

for (const [name, text] of Object.values(KEYS)) {
  const row = element('div');
  row.append(element('dt', name), element('dd', text));
  document.getElementById('keys-list').append(row);
}
document.getElementById('theme').onclick = turnTheme;
document.getElementById('help').onclick = turnHelp;
darkness.addEventListener('change', () => setTheme(darkness.matches));
