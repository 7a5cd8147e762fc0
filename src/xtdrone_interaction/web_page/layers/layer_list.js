// The list of layers in the 3D view: what there is, by kind and with the vehicles' topics of one name together.
import { html, render } from '../vendor/preact_htm.js';

const PERIOD = 3000; // ms between two looks at the topics, while the list is open
const TITLES = { 'nav_msgs/Path': 'Paths', 'sensor_msgs/PointCloud2': 'Clouds', 'sensor_msgs/LaserScan': 'Scans', 'nav_msgs/OccupancyGrid': 'Maps' };
const RATES = { 'nav_msgs/Path': 2, 'sensor_msgs/PointCloud2': 4, 'sensor_msgs/LaserScan': 5, 'nav_msgs/OccupancyGrid': 1 };
const STORED = 'xtdrone-layers';

// Returns the name under which vehicles' topics are together, a star for the vehicle, and the others alone.
function groupOf(name, vehicles) {
  const [, first, ...rest] = name.split('/');
  return vehicles.has(first) && rest.length ? `/*/${rest.join('/')}` : name;
}

export class LayerList {
  #station;
  #feed;
  #box = document.createElement('div');
  #layers = []; // that are published
  #chosen = new Map(stored().map(({ name, type }) => [name, type])); // published now or later
  #faults = new Map();
  #open = false;
  #timer = null;
  #changed;
  #offs;

  /**
   * @param element that holds the list
   * @param station the page's connection
   * @param feed of the layers
   * @param changed called when a topic has been switched on or off
   */
  constructor(element, station, feed, changed) {
    this.#station = station;
    this.#feed = feed;
    this.#changed = changed;
    this.#box.className = 'overlay layer-list';
    element.append(this.#box);
    for (const [name, type] of this.#chosen) feed.open(name, RATES[type], type);
    this.#offs = [station.onConnect(() => this.#look()), station.on('fleet.roster', () => this.#draw())];
    this.#draw();
  }

  end() {
    clearInterval(this.#timer);
    this.#offs.forEach((off) => off());
    render(null, this.#box);
  }

  /** Tells what is wrong with a topic; '' when that has ended. */
  fault(topic, text) {
    if ((this.#faults.get(topic) ?? '') === text) return;
    this.#faults.set(topic, text);
    this.#draw();
  }

  async #look() {
    try {
      this.#layers = (await this.#station.call('layers.list')).layers;
    } catch { /* the bar tells that the connection has broken */ }
    this.#draw();
  }

  #toggleList() {
    this.#open = !this.#open;
    clearInterval(this.#timer);
    if (this.#open) this.#timer = setInterval(() => this.#look(), PERIOD);
    this.#look();
  }

  #switch(layers, on) {
    for (const { name, type } of layers) {
      if (on) this.#chosen.set(name, type); else this.#chosen.delete(name);
      if (on) this.#feed.open(name, RATES[type], type); else this.#feed.close(name);
      this.#faults.delete(name);
      this.#changed(name, on);
    }
    store([...this.#chosen].map(([name, type]) => ({ name, type })));
    this.#draw();
  }

  #groups() {
    const vehicles = new Set(this.#station.roster.vehicles.map(({ name }) => name));
    const groups = new Map();
    const published = new Set(this.#layers.map(({ name }) => name));
    const awaited = [...this.#chosen].filter(([name]) => !published.has(name)).map(([name, type]) => ({ name, type, awaited: true }));
    for (const layer of [...this.#layers, ...awaited]) {
      const name = groupOf(layer.name, vehicles);
      const key = `${layer.type} ${name}`;
      if (!groups.has(key)) groups.set(key, { name, type: layer.type, layers: [] });
      groups.get(key).layers.push(layer);
    }
    return [...groups.values()];
  }

  #draw() {
    const count = this.#feed.topics.length;
    const button = html`<button data-layers="list" class=${this.#open ? 'on' : ''} title="paths, clouds, scans and maps"
      onclick=${() => this.#toggleList()}>Layers${count ? ` ${count}` : ''}</button>`;
    const groups = this.#open ? this.#groups() : [];
    const sections = Object.entries(TITLES).map(([type, title]) => [title, groups.filter((group) => group.type === type)])
      .filter(([, found]) => found.length);
    render(html`${button}${this.#open ? html`<div class="layer-rows">
      ${sections.map(([title, found]) => html`<b>${title}</b>${found.map((group) => this.#group(group))}`)}
      ${groups.length ? null : html`<span class="soft">No node publishes paths, clouds, scans or maps.</span>`}</div>` : null}`, this.#box);
  }

  #group({ name, layers }) {
    const on = layers.filter((layer) => this.#feed.has(layer.name)).length;
    const head = this.#row(name, layers, on === layers.length, on > 0 && on < layers.length);
    if (layers.length === 1) return this.#row(layers[0].name, layers, on === 1, false);
    return html`<details><summary>${head}</summary>
      ${layers.map((layer) => this.#row(layer.name, [layer], this.#feed.has(layer.name), false))}</details>`;
  }

  #row(name, layers, on, some) {
    const fault = layers.map((layer) => this.#faults.get(layer.name)).find(Boolean);
    const awaited = layers.every((layer) => layer.awaited) ? html` <span class="soft">not published yet</span>` : null;
    return html`<label title=${fault ?? name}><input type="checkbox" data-layer=${name} checked=${on} indeterminate=${some}
      onchange=${(event) => this.#switch(layers, event.target.checked)}/> ${name}${layers.length > 1 ? html` <span class="soft">${layers.length}</span>` : null}${awaited}
      ${fault ? html`<div class="warn" data-fault=${name}>${fault}</div>` : null}</label>`;
  }
}

function stored() {
  try { return JSON.parse(localStorage.getItem(STORED) ?? '[]').filter(({ name, type }) => typeof name === 'string' && TITLES[type]); } catch { return []; }
}

function store(layers) {
  try { localStorage.setItem(STORED, JSON.stringify(layers)); } catch { /* a private window has none */ }
}
