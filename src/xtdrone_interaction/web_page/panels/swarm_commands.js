// XTDrone's commands to leader and vehicles, formations by their picture, and a pattern drawn by hand.
import { html, render } from '../vendor/preact_htm.js';
import { toast } from '../station.js';

const COMMANDS = ['ARM', 'OFFBOARD', 'HOVER', 'AUTO.TAKEOFF', 'AUTO.LAND', 'AUTO.RTL', 'DISARM'];
const SIZE = 96; // px of a picture
const BOARD = 320; // px of the board to draw on
const SPAN = 24; // m that the board is wide

/** Returns dots of a pattern as seen from the south-west and above, within a picture. */
function dots(slots) {
  const points = [[0, 0, 0], ...slots].map(([x, y, z]) => [x - 0.45 * y, -z - 0.35 * y - 0.12 * x]);
  const [xs, ys] = [0, 1].map((axis) => points.map((point) => point[axis]));
  const span = Math.max(Math.max(...xs) - Math.min(...xs), Math.max(...ys) - Math.min(...ys), 1);
  const middle = [xs, ys].map((values) => (Math.max(...values) + Math.min(...values)) / 2);
  return points.map((point) => point.map((value, axis) => SIZE / 2 + ((value - middle[axis]) / span) * (SIZE - 24)));
}

class Swarm {
  #element;
  #station;
  #patterns = [];
  #target = 'leader';
  #text = '';
  #drawn = []; // slots, m: [x, y]
  #height = 0;
  #offs;

  constructor(element, station) {
    this.#element = element;
    this.#station = station;
    this.#offs = [
      station.onConnect(() => this.#load()),
      station.on('fleet.roster', () => this.#load()),
      station.selection.onChange(() => this.#draw()),
    ];
    this.#draw();
  }

  end() {
    this.#offs.forEach((off) => off());
    render(null, this.#element);
  }

  async #load() {
    this.#patterns = await this.#station.call('swarm.patterns').catch(() => []);
    this.#draw();
  }

  #send(text, target = this.#target) {
    const to = target === 'leader' ? { target } : { vehicles: this.#station.selection.names };
    this.#station.call('swarm.command', { ...to, text }).then(toast, (error) => toast(error.message, 'bad'));
  }

  #draw() {
    const selected = this.#station.selection.size;
    render(html`
      <div class="operate"><div class="row"><b>XTDrone's commands</b>
        <span class="group">
          <button class=${this.#target === 'leader' ? 'on' : ''} onclick=${() => { this.#target = 'leader'; this.#draw(); }}>leader</button>
          <button class=${this.#target === 'leader' ? '' : 'on'} onclick=${() => { this.#target = 'selected'; this.#draw(); }}>${selected} selected</button></span></div>
      <div class="row">${COMMANDS.map((text) => html`<button data-command=${text} onclick=${() => this.#send(text)}>${text}</button>`)}</div>
      <div class="row"><input placeholder="another command" value=${this.#text} oninput=${(event) => { this.#text = event.target.value; }}
          onkeydown=${(event) => { if (event.key === 'Enter') this.#send(this.#text); }}/>
        <button onclick=${() => this.#send(this.#text)}>Send</button></div></div>
      <div class="row"><b>Formation</b><span class="soft">${this.#patterns.length ? 'sent to the leader' : 'needs two vehicles of a type'}</span></div>
      <div class="row">${this.#patterns.map(({ name, slots }) => html`<button data-pattern=${name} title=${name} style="padding:3px" class="operate-look"
          onclick=${() => this.#send(name, 'leader')}>
        <svg width=${SIZE} height=${SIZE} viewBox=${`0 0 ${SIZE} ${SIZE}`}>${dots(slots).map(([x, y], i) =>
          html`<circle cx=${x} cy=${y} r=${slots.length > 60 ? 2 : 4} fill=${i ? 'var(--accent)' : 'var(--warn)'}/>`)}</svg>
        <div>${name}</div></button>`)}</div>
      ${this.#board()}`, this.#element);
  }

  /** The board for a pattern of one's own, seen from above: the leader is in the middle. */
  #board() {
    const needed = Math.max(this.#station.roster.vehicles.length - 1, 0);
    const px = (value) => BOARD / 2 + (value / SPAN) * BOARD;
    const add = (event) => {
      const { left, top, width } = event.currentTarget.getBoundingClientRect();
      const scale = SPAN / width;
      const point = [(event.clientX - left - width / 2) * scale, -(event.clientY - top - width / 2) * scale];
      const near = this.#drawn.findIndex(([x, y]) => Math.hypot(x - point[0], y - point[1]) < 0.8);
      if (near >= 0) this.#drawn.splice(near, 1);
      else if (this.#drawn.length < needed) this.#drawn.push([...point, this.#height]);
      this.#draw();
    };
    return html`<div class="operate"><div class="row"><b>Own pattern</b><span class="soft">seen from above, leader at the centre; click to add or remove a slot</span></div>
      <svg data-board width=${BOARD} height=${BOARD} viewBox=${`0 0 ${BOARD} ${BOARD}`} onclick=${add}
        style="background:var(--raised);border:1px solid var(--line);border-radius:8px;cursor:crosshair;max-width:100%">
        ${Array.from({ length: SPAN / 2 - 1 }, (_, i) => px(2 * (i + 1) - SPAN / 2)).map((at) =>
          html`<path d=${`M${at} 0V${BOARD}M0 ${at}H${BOARD}`} stroke="var(--line)" stroke-width="0.7"/>`)}
        <circle cx=${px(0)} cy=${px(0)} r="6" fill="var(--warn)"/>
        ${this.#drawn.map(([x, y, z]) => html`<circle cx=${px(x)} cy=${px(-y)} r="6" fill="var(--accent)"/>
          <text x=${px(x) + 8} y=${px(-y) + 4} font-size="11" fill="var(--soft)">${z ? `${z} m` : ''}</text>`)}</svg>
      <div class="row"><label>height over the leader <input type="number" step="0.5" value=${this.#height}
          oninput=${(event) => { this.#height = event.target.valueAsNumber || 0; }}/> m</label>
        <span class="soft">${this.#drawn.length} of ${needed} slots</span>
        <button onclick=${() => { this.#drawn = []; this.#draw(); }}>Clear</button>
        <button class="primary" data-draw disabled=${this.#drawn.length !== needed || !needed} onclick=${() => this.#station.call('swarm.draw', { slots: this.#drawn })
          .then(toast, (error) => toast(error.message, 'bad'))}>Fly it</button></div></div>`;
  }
}

function mount(element, station) {
  const swarm = new Swarm(element, station);
  return () => swarm.end();
}

export const panel = { name: 'swarm', title: 'Swarm', icon: '⁂', mount };
