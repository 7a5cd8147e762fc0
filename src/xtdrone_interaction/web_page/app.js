// The page's frame: bar, stage (3D, map), dock (all other panels), theme.
import { Station, toast } from './station.js';
import { panels } from './panels/index.js';

const station = new Station();
globalThis.station = station; // for the console
const $ = (id) => document.getElementById(id);
const mounted = new Map(); // panel's name -> its element

/** Shows a panel of a place; a panel is mounted when it is first shown, and unmounted when another replaces it. */
function show(place, panel) {
  const body = $(`${place}-body`);
  for (const button of $(`${place}-tabs`).children) {
    button.setAttribute('aria-selected', String(button.dataset.panel === panel.name));
  }
  for (const [name, entry] of mounted) {
    if (entry.place !== place || name === panel.name) continue;
    entry.unmount?.();
    entry.element.remove();
    mounted.delete(name);
  }
  if (!mounted.has(panel.name)) {
    const element = document.createElement('div');
    element.className = 'mount';
    element.dataset.panel = panel.name;
    body.append(element);
    const entry = { place, element };
    mounted.set(panel.name, entry);
    try { entry.unmount = panel.mount(element, station); } catch (error) {
      element.textContent = `${panel.title}: ${error.message}`;
      console.error(error);
    }
  }
  remember(`panel-${place}`, panel.name);
}

function addTab(place, panel) {
  const button = document.createElement('button');
  button.dataset.panel = panel.name;
  button.setAttribute('role', 'tab');
  button.title = panel.title;
  button.textContent = `${panel.icon ?? ''} ${panel.title}`.trim();
  button.onclick = () => show(place, panel);
  $(`${place}-tabs`).append(button);
}

function remember(key, value) {
  try { localStorage.setItem(`xtdrone-${key}`, value); } catch { /* a private window has none */ }
}

function remembered(key) {
  try { return localStorage.getItem(`xtdrone-${key}`); } catch { return null; }
}

function setTheme(theme) {
  document.documentElement.dataset.theme = theme;
  remember('theme', theme);
  station.emit('station.theme', theme);
}

function moveDivider() {
  const divider = $('divider');
  divider.onpointerdown = (event) => divider.setPointerCapture(event.pointerId);
  divider.onpointermove = (event) => {
    if (!divider.hasPointerCapture(event.pointerId)) return;
    const width = Math.min(Math.max(innerWidth - event.clientX, 260), innerWidth - 240);
    document.documentElement.style.setProperty('--dock', `${width}px`);
    remember('dock', `${width}px`);
    dispatchEvent(new Event('resize'));
  };
}

for (const place of ['stage', 'dock']) {
  const own = panels.filter((panel) => (panel.place ?? 'dock') === place);
  own.forEach((panel) => addTab(place, panel));
  const first = own.find((panel) => panel.name === remembered(`panel-${place}`)) ?? own[0];
  if (first) show(place, first);
}
for (const panel of panels.filter((p) => p.place === 'bar')) panel.mount($('time'), station);
setTheme(remembered('theme') ?? (matchMedia('(prefers-color-scheme: dark)').matches ? 'dark' : 'light'));
if (remembered('dock')) document.documentElement.style.setProperty('--dock', remembered('dock'));
$('theme').onclick = () => setTheme(document.documentElement.dataset.theme === 'dark' ? 'light' : 'dark');
moveDivider();

/** Shows the panel of a name, for panels that lead to others. */
station.showPanel = (name) => {
  const panel = panels.find((p) => p.name === name);
  if (panel) show(panel.place ?? 'dock', panel);
};

station.on('station.state', ({ connected, silent, refused, role }) => {
  const link = $('link');
  const state = silent ? 'no answer' : role === 'operate' ? 'connected' : 'watching';
  link.textContent = connected ? state : refused ? 'wrong token' : 'reconnecting';
  link.className = `pill ${connected && !silent ? 'good' : 'bad'}`;
  document.body.classList.toggle('old', !connected || silent); // what is shown
  document.body.classList.toggle('watching', role !== 'operate');
  if (refused) toast('The token in the URL is missing or wrong: open the URL that the station printed.', 'bad');
});
station.on('actions.other', ({ page, text }) => toast(`page ${page}: ${text}`));
station.start();
