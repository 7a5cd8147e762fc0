// The map: vehicles from above, search with region, coverage, finds and progress, missions, and plans that are drawn and uploaded.
import { html, render } from '../vendor/preact_htm.js';
import { COLUMNS } from '../fleet_frame.js';
import { LayerFeed } from '../layers/layer_feed.js';
import { UNKNOWN } from '../layers/layer_frame.js';
import { colourOf } from '../scene/vehicle_meshes.js';
import { toast } from '../station.js';

const FLEET = 1;
const CLICK = 4; // px between press and release
const CLOSE = 12; // px to the first corner that closes a polygon
const SIGMA = 2; // of a find's ellipse
const COVERAGE = '/xtdrone/search/coverage';
const SEEN = [44, 123, 229, 255]; // colour of a cell
const COVERAGE_RATE = 2; // Hz of wall time

class Map2D {
  #station;
  #canvas = document.createElement('canvas');
  #tools = document.createElement('div');
  #offs = [];
  #scale = 12; // px per m
  #middle = [0, 0]; // m
  #search = { region: null, progress: null, events: [] };
  #missions = {};
  #drawing = null; // 'region' or 'hole' while one is drawn
  #corners = []; // of what is drawn, m
  #region = null; // {region, holes} that is drawn
  #options = { height: 12, speed: 5, overlap: 0.2 };
  #plan = null;
  #framed = false;
  #due = 0; // number of the next drawing that the browser has been asked for
  #down = null;
  #style = {};
  #feed;
  #coverage = null; // the newest frame of the layer, with its cells as a picture

  constructor(element, station) {
    this.#station = station;
    element.style.overflow = 'hidden';
    this.#tools.className = 'overlay';
    this.#tools.style.cssText = 'top:10px;left:10px;max-width:calc(100% - 20px)';
    element.append(this.#canvas, this.#tools);
    const resized = new ResizeObserver(() => this.#resize(element));
    resized.observe(element);
    this.#offs = [
      () => resized.disconnect(),
      station.onBinary(FLEET, () => this.#draw()),
      station.on('map.search', (search) => {
        this.#search = search;
        if (search.progress) this.#feed.open(COVERAGE, COVERAGE_RATE);
        this.#draw();
      }),
      station.on('map.missions', () => this.#load()),
      station.on('station.theme', () => this.#draw()),
      station.selection.onChange(() => { this.#draw(); this.#drawTools(); }),
      station.onConnect(() => this.#load()),
    ];
    this.#feed = new LayerFeed(station, (_topic, frame) => {
      this.#coverage = { ...frame, picture: pictureOf(frame) };
      this.#draw();
    });
    this.#listen();
    this.#drawTools();
  }

  end() {
    this.#offs.forEach((off) => off());
    cancelAnimationFrame(this.#due);
    this.#due = -1; // nothing is drawn any more
    this.#feed.end();
    render(null, this.#tools);
    this.#canvas.parentElement?.replaceChildren();
  }

  async #load() {
    try {
      this.#search = await this.#station.call('map.search');
      this.#missions = await this.#station.call('map.missions');
      if (this.#search.progress) this.#feed.open(COVERAGE, COVERAGE_RATE);
      if (this.#search.trouble) toast(this.#search.trouble, 'bad');
    } catch (error) { toast(error.message, 'bad'); }
    this.#draw();
  }

  // ---- pointer

  #listen() {
    const canvas = this.#canvas;
    canvas.style.touchAction = 'none';
    canvas.onpointerdown = (event) => {
      canvas.setPointerCapture(event.pointerId);
      this.#down = { at: [event.offsetX, event.offsetY], middle: [...this.#middle], moved: false };
    };
    canvas.onpointermove = (event) => {
      if (!this.#down) return;
      const shift = [event.offsetX - this.#down.at[0], event.offsetY - this.#down.at[1]];
      if (Math.hypot(...shift) > CLICK) this.#down.moved = true;
      if (!this.#down.moved) return;
      this.#middle = [this.#down.middle[0] - shift[0] / this.#scale, this.#down.middle[1] + shift[1] / this.#scale];
      this.#draw();
    };
    canvas.onpointerup = (event) => {
      const { moved } = this.#down ?? { moved: true };
      this.#down = null;
      if (!moved) this.#clicked(event);
    };
    canvas.onwheel = (event) => {
      event.preventDefault();
      const before = this.#place(event.offsetX, event.offsetY);
      this.#scale = Math.min(Math.max(this.#scale * Math.exp(-event.deltaY / 400), 0.2), 400);
      const after = this.#place(event.offsetX, event.offsetY);
      this.#middle = this.#middle.map((value, axis) => value + before[axis] - after[axis]);
      this.#draw();
    };
  }

  #clicked(event) {
    const place = this.#place(event.offsetX, event.offsetY);
    if (this.#station.picking) { this.#station.picking(place); return; }
    if (this.#drawing) { this.#addCorner(place, [event.offsetX, event.offsetY]); return; }
    const { vehicles } = this.#station.roster;
    const near = vehicles.map(({ name }, i) => ({ name, gap: Math.hypot(...this.#seen(i).map((v, k) => v - [event.offsetX, event.offsetY][k])) }))
      .sort((a, b) => a.gap - b.gap)[0];
    if (!near || !(near.gap < 20)) return;
    if (event.shiftKey || event.ctrlKey) this.#station.selection.toggle(near.name);
    else this.#station.selection.set([near.name]);
  }

  #addCorner(place, at) {
    const first = this.#corners[0] && this.#pixel(this.#corners[0]);
    const closes = first && this.#corners.length >= 3 && Math.hypot(first[0] - at[0], first[1] - at[1]) < CLOSE;
    if (!closes) { this.#corners.push(place.map((value) => Math.round(value * 10) / 10)); } else this.#close();
    this.#draw();
    this.#drawTools();
  }

  #close() {
    if (this.#drawing === 'region') this.#region = { region: this.#corners, holes: [] };
    else this.#region.holes.push(this.#corners);
    this.#corners = [];
    this.#drawing = null;
    this.#plan = null;
  }

  // ---- plans

  async #makePlan() {
    const vehicles = this.#station.selection.names;
    try {
      this.#plan = await this.#station.call('map.plan', { region: this.#region, vehicles, ...this.#options });
    } catch (error) { toast(error.message, 'bad'); }
    this.#draw();
    this.#drawTools();
  }

  async #upload() {
    try {
      const results = await this.#station.call('map.upload', { plan: this.#plan.plan });
      for (const [name, { ok, text }] of Object.entries(results)) if (!ok) toast(`${name}: ${text}`, 'bad');
      const stored = Object.values(results).filter(({ ok }) => ok).length;
      if (stored) toast(`${stored} vehicles have stored their plan; arm them and set AUTO.MISSION to fly it`);
    } catch (error) { toast(error.message, 'bad'); }
  }

  #drawTools() {
    const { selection } = this.#station;
    const start = (kind) => () => { this.#drawing = this.#drawing === kind ? null : kind; this.#corners = []; this.#draw(); this.#drawTools(); };
    const field = (name, label, step) => html`<label>${label} <input type="number" step=${step} value=${this.#options[name]} style="width:4.5em"
      oninput=${(event) => { this.#options[name] = event.target.valueAsNumber; }}/></label>`;
    const { progress } = this.#search;
    render(html`<div class="row" style="margin:0">
        <button onclick=${() => { this.#framed = false; this.#draw(); }}>All</button>
        <button data-map="region" class=${this.#drawing === 'region' ? 'on' : ''} onclick=${start('region')}>Draw region</button>
        <button class=${this.#drawing === 'hole' ? 'on' : ''} disabled=${!this.#region} onclick=${start('hole')}>Hole</button>
        ${this.#region ? html`${field('height', 'height m', 1)}${field('speed', 'm/s', 0.5)}${field('overlap', 'overlap', 0.1)}
          <button data-map="plan" disabled=${!selection.size} title="divide among the selected vehicles" onclick=${() => this.#makePlan()}>Plan for ${selection.size}</button>
          <button data-map="upload" class="primary operate" disabled=${!this.#plan} onclick=${() => this.#upload()}>Upload</button>
          <button onclick=${() => { this.#region = this.#plan = null; this.#draw(); this.#drawTools(); }}>Clear</button>` : null}</div>
      ${this.#drawing ? html`<div class="soft">Click the corners; click the first one again to close.</div>` : null}
      ${this.#plan ? html`<div class="soft">Shaded: the ground that the cameras see. They look ahead, so a lane begins before that ground.</div>` : null}
      ${progress ? html`<div>search: ${progress.phase}, ${progress.text}</div>` : null}`, this.#tools);
  }

  // ---- drawing

  #pixel([x, y]) {
    return [this.#canvas.clientWidth / 2 + (x - this.#middle[0]) * this.#scale, this.#canvas.clientHeight / 2 - (y - this.#middle[1]) * this.#scale];
  }

  #place(x, y) {
    return [this.#middle[0] + (x - this.#canvas.clientWidth / 2) / this.#scale, this.#middle[1] - (y - this.#canvas.clientHeight / 2) / this.#scale];
  }

  #seen(i) {
    const rows = this.#station.fleet?.vehicles ?? [];
    return this.#pixel([rows[i * COLUMNS] ?? NaN, rows[i * COLUMNS + 1] ?? NaN]);
  }

  #resize(element) {
    const ratio = devicePixelRatio;
    this.#canvas.width = element.clientWidth * ratio;
    this.#canvas.height = element.clientHeight * ratio;
    this.#canvas.style.width = `${element.clientWidth}px`;
    this.#canvas.style.height = `${element.clientHeight}px`;
    this.#draw();
  }

  #frame() {
    const rows = this.#station.fleet?.vehicles ?? [];
    const points = [...(this.#search.region?.region ?? []), ...(this.#region?.region ?? [])];
    for (let i = 0; i < rows.length; i += COLUMNS) if (!Number.isNaN(rows[i])) points.push([rows[i], rows[i + 1]]);
    if (!points.length || !this.#canvas.clientWidth) return;
    const span = [0, 1].map((axis) => {
      const values = points.map((point) => point[axis]);
      return [Math.min(...values), Math.max(...values)];
    });
    this.#middle = span.map(([low, high]) => (low + high) / 2);
    const room = [this.#canvas.clientWidth, this.#canvas.clientHeight];
    this.#scale = Math.min(...span.map(([low, high], axis) => (0.75 * room[axis]) / Math.max(high - low, 12)));
    this.#framed = true;
  }

  /** Draws with the browser's next picture: a busy one would be asked for more of them than it can draw. */
  #draw() { this.#due ||= requestAnimationFrame(() => this.#paint()); }

  #paint() {
    this.#due = 0;
    if (!this.#framed) this.#frame();
    const context = this.#canvas.getContext('2d');
    const style = getComputedStyle(document.documentElement);
    this.#style = Object.fromEntries(['--earth', '--soft', '--accent', '--text', '--bad', '--good', '--warn', '--panel'].map((name) => [name, style.getPropertyValue(name).trim()]));
    context.setTransform(devicePixelRatio, 0, 0, devicePixelRatio, 0, 0);
    context.fillStyle = this.#style['--earth'];
    context.fillRect(0, 0, this.#canvas.clientWidth, this.#canvas.clientHeight);
    this.#drawGrid(context);
    if (this.#coverage) this.#drawCoverage(context, this.#coverage);
    if (this.#search.region) this.#drawRegion(context, this.#search.region, this.#style['--good']);
    if (this.#region) this.#drawRegion(context, this.#region, this.#style['--accent']);
    this.#drawWays(context);
    this.#drawFinds(context);
    if (this.#corners.length) this.#line(context, this.#corners, this.#style['--accent'], 2, true);
    this.#station.roster.vehicles.forEach(({ name }, i) => this.#drawVehicle(context, name, i));
  }

  #drawGrid(context) {
    const wished = 60 / this.#scale;
    const power = 10 ** Math.floor(Math.log10(wished));
    const step = [1, 2, 5, 10].map((factor) => factor * power).find((value) => value >= wished);
    const [left, top] = this.#place(0, 0);
    const [right, bottom] = this.#place(this.#canvas.clientWidth, this.#canvas.clientHeight);
    context.strokeStyle = context.fillStyle = this.#style['--soft'];
    context.font = '11px system-ui, sans-serif';
    context.textAlign = 'left';
    context.lineWidth = 0.4;
    context.beginPath();
    for (let x = Math.ceil(left / step) * step; x < right; x += step) {
      const [at] = this.#pixel([x, 0]);
      context.moveTo(at, 0);
      context.lineTo(at, this.#canvas.clientHeight);
      context.fillText(`${Number(x.toPrecision(6))}`, at + 3, this.#canvas.clientHeight - 4);
    }
    for (let y = Math.ceil(bottom / step) * step; y < top; y += step) {
      const at = this.#pixel([0, y])[1];
      context.moveTo(0, at);
      context.lineTo(this.#canvas.clientWidth, at);
      context.fillText(`${Number(y.toPrecision(6))} m`, 3, at - 3);
    }
    context.stroke();
  }

  #line(context, places, colour, width = 1.5, dots = false) {
    context.strokeStyle = context.fillStyle = colour;
    context.lineWidth = width;
    context.beginPath();
    places.forEach((place, i) => context[i ? 'lineTo' : 'moveTo'](...this.#pixel(place)));
    context.stroke();
    if (dots) places.forEach((place) => { const [x, y] = this.#pixel(place); context.fillRect(x - 4, y - 4, 8, 8); });
  }

  /** Cells that the cameras have shown; others of the region stay as they are. */
  #drawCoverage(context, { picture, origin, side, columns, rows, orientation }) {
    const [x, y] = this.#pixel(origin);
    const [w, , , qz] = orientation;
    context.save();
    context.translate(x, y);
    context.rotate(-2 * Math.atan2(qz, w));
    context.imageSmoothingEnabled = false;
    context.globalAlpha = 0.42;
    context.scale(this.#scale * side, -this.#scale * side);
    context.drawImage(picture, 0, 0, columns, rows);
    context.restore();
  }

  #drawRegion(context, { region, holes }, colour) {
    context.beginPath();
    for (const ring of [region, ...holes]) {
      ring.forEach((place, i) => context[i ? 'lineTo' : 'moveTo'](...this.#pixel(place)));
      context.closePath();
    }
    context.globalAlpha = 0.14;
    context.fillStyle = colour;
    context.fill('evenodd');
    context.globalAlpha = 1;
    context.strokeStyle = colour;
    context.lineWidth = 2;
    context.stroke();
  }

  #drawWays(context) {
    const { vehicles } = this.#station.roster;
    vehicles.forEach(({ name }, i) => {
      const colour = `#${colourOf(i).getHexString()}`;
      const planned = this.#plan?.ways[name];
      if (planned) {
        this.#plan.seen[name].forEach((corners) => this.#area(context, corners, colour));
        this.#line(context, planned, colour, 2.5);
      }
      else if (this.#missions[name]) this.#line(context, this.#missions[name], colour, 1.2);
    });
  }

  #area(context, corners, colour) {
    context.beginPath();
    corners.forEach((place, i) => context[i ? 'lineTo' : 'moveTo'](...this.#pixel(place)));
    context.globalAlpha = 0.1;
    context.fillStyle = colour;
    context.fill();
    context.globalAlpha = 1;
  }

  /** Finds as ellipses of two standard deviations; candidates and rejected ones as crosses. */
  #drawFinds(context) {
    for (const { event, position, covariance } of this.#search.events ?? []) {
      if (!position) continue;
      const [x, y] = this.#pixel(position);
      if (event === 'confirmed') {
        this.#ellipse(context, x, y, covariance ?? [0, 0, 0, 0]);
      } else if (event === 'candidate' || event === 'rejected') {
        context.strokeStyle = event === 'candidate' ? this.#style['--warn'] : this.#style['--soft'];
        context.lineWidth = 2;
        context.beginPath();
        context.moveTo(x - 5, y - 5); context.lineTo(x + 5, y + 5);
        context.moveTo(x + 5, y - 5); context.lineTo(x - 5, y + 5);
        context.stroke();
      }
    }
  }

  #ellipse(context, x, y, [xx, xy, , yy]) {
    const middle = (xx + yy) / 2;
    const apart = Math.hypot((xx - yy) / 2, xy);
    const radii = [middle + apart, middle - apart].map((value) => Math.max(SIGMA * Math.sqrt(Math.max(value, 0)) * this.#scale, 5));
    context.strokeStyle = this.#style['--bad'];
    context.lineWidth = 2.5;
    context.beginPath();
    context.ellipse(x, y, ...radii, -0.5 * Math.atan2(2 * xy, xx - yy), 0, 2 * Math.PI);
    context.stroke();
  }

  #drawVehicle(context, name, i) {
    const [x, y] = this.#seen(i);
    if (Number.isNaN(x)) return;
    const row = this.#station.fleet.vehicles.subarray(i * COLUMNS, (i + 1) * COLUMNS);
    const [w, qx, qy, qz] = row.subarray(3, 7);
    const heading = Math.atan2(2 * (w * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz));
    context.save();
    context.translate(x, y);
    context.rotate(-heading);
    context.fillStyle = `#${colourOf(i).getHexString()}`;
    context.strokeStyle = this.#station.selection.has(name) ? this.#style['--text'] : this.#style['--panel'];
    context.lineWidth = this.#station.selection.has(name) ? 3 : 1.5;
    context.beginPath();
    context.moveTo(11, 0); context.lineTo(-8, 7); context.lineTo(-4, 0); context.lineTo(-8, -7);
    context.closePath();
    context.fill();
    context.stroke();
    context.restore();
    context.fillStyle = this.#style['--text'];
    context.textAlign = 'center';
    context.font = '12px system-ui, sans-serif';
    context.fillText(`${name}  ${row[2].toFixed(1)} m`, x, y - 13);
  }

  /** Returns the numbers of cells of the search that are seen and not seen; for tests. */
  get coverage() {
    const cells = this.#coverage?.cells ?? [];
    return { seen: cells.filter((cell) => cell !== UNKNOWN && cell > 0).length, unseen: cells.filter((cell) => cell === 0).length };
  }

  /** Returns where a place (m) is drawn, px; for tests. */
  pixelOf(place) { return this.#pixel(place); }
}

/** Returns the cells of a grid that are seen as a picture, its first row the first one of the grid. */
function pictureOf({ cells, columns, rows }) {
  const picture = document.createElement('canvas');
  [picture.width, picture.height] = [columns, rows];
  const content = new ImageData(columns, rows);
  for (let i = 0; i < cells.length; i++) {
    if (cells[i] !== UNKNOWN && cells[i] > 0) content.data.set(SEEN, 4 * i);
  }
  picture.getContext('2d').putImageData(content, 0, 0);
  return picture;
}

function mount(element, station) {
  const map = new Map2D(element, station);
  station.map = map;
  return () => map.end();
}

export const panel = { name: 'map', title: 'Map', icon: '◫', place: 'stage', mount };
