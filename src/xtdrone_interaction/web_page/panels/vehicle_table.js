// The table of vehicles, and commands to the selected ones.
import { html, render } from '../vendor/preact_htm.js';
import { COLUMNS } from '../fleet_frame.js';
import { confirmed, toast } from '../station.js';

const PERIOD = 300; // ms
const MODES = ['AUTO.LOITER', 'AUTO.RTL', 'AUTO.LAND', 'AUTO.TAKEOFF', 'AUTO.MISSION', 'OFFBOARD', 'POSCTL', 'ALTCTL', 'STABILIZED'];
const LOW_BATTERY = 0.3;
const NEAR = 1.0; // m

const number = (value, digits = 1) => (Number.isFinite(value) ? value.toFixed(digits) : '–');

/** Returns the distance of each vehicle to the next one, m; NaN for one alone. */
function nearest(rows) {
  const count = rows.length / COLUMNS;
  const best = new Array(count).fill(NaN);
  for (let i = 0; i < count; i++) {
    for (let k = i + 1; k < count; k++) {
      const gap = Math.hypot(...[0, 1, 2].map((axis) => rows[i * COLUMNS + axis] - rows[k * COLUMNS + axis]));
      if (!(best[i] <= gap)) best[i] = gap;
      if (!(best[k] <= gap)) best[k] = gap;
    }
  }
  return best;
}

class Table {
  #station;
  #element;
  #height = 3;
  #mode = MODES[0];
  #busy = false;
  #offs;

  constructor(element, station) {
    this.#element = element;
    this.#station = station;
    const timer = setInterval(() => this.#draw(), PERIOD);
    this.#offs = [() => clearInterval(timer), station.selection.onChange(() => this.#draw())];
    this.#draw();
  }

  end() {
    this.#offs.forEach((off) => off());
    this.#station.picking = null;
    render(null, this.#element);
  }

  /** Sends a command to the selected vehicles and tells what each refused. */
  async #command(params) {
    const vehicles = this.#station.selection.names;
    this.#busy = true;
    this.#draw();
    try {
      const results = await this.#station.call('vehicles.command', { vehicles, ...params });
      const refused = Object.entries(results).filter(([, { ok }]) => !ok);
      refused.slice(0, 4).forEach(([name, { text }]) => toast(text.startsWith(name) ? text : `${name}: ${text}`, 'bad'));
      if (refused.length > 4) toast(`${refused.length - 4} more vehicles refused`, 'bad');
      const done = vehicles.length - refused.length;
      if (done) toast(`${params.action}: ${done === 1 ? vehicles.find((name) => results[name]?.ok) : `${done} vehicles`}`);
    } catch (error) { toast(error.message, 'bad'); }
    this.#busy = false;
    this.#draw();
  }

  async #kill() {
    const names = this.#station.selection.names.join(', ');
    if (await confirmed(`Stop the motors of ${names} immediately? A vehicle in the air will fall.`, 'Kill')) {
      this.#command({ action: 'kill' });
    }
  }

  #goto() {
    const station = this.#station;
    if (station.picking) { station.picking = null; this.#draw(); return; }
    toast('Click the goal on the ground, in 3D or on the map.');
    station.picking = ([x, y]) => {
      station.picking = null;
      this.#command({ action: 'goto', place: [x, y, this.#height] });
    };
    this.#draw();
  }

  #draw() {
    const station = this.#station;
    const rows = station.fleet?.vehicles ?? new Float32Array(0);
    render(html`${this.#buttons()}${this.#list(rows)}${this.#findings()}`, this.#element);
  }

  #buttons() {
    const { selection, roster } = this.#station;
    const none = selection.size === 0 || this.#busy;
    const act = (action, label, title, extra = {}) => html`<button data-action=${action} title=${title} disabled=${none}
      onclick=${() => this.#command({ action, ...extra })}>${label}</button>`;
    const all = roster.vehicles.map(({ name }) => name);
    return html`<div class="row">
        <button data-action="all" onclick=${() => selection.set(selection.size === all.length ? [] : all)}>
          ${selection.size === all.length && all.length ? 'None' : 'All'}</button>
        <span class="soft">${selection.size} of ${all.length} selected</span></div>
      <div class="operate"><div class="row">
        <label>height <input type="number" step="0.5" min="0.5" max="1000" value=${this.#height}
          oninput=${(event) => { this.#height = event.target.valueAsNumber; }}/> m</label>
        ${act('arm', 'Arm', 'arm')}
        ${act('takeoff', 'Take off', 'arm and climb to the height', { height: this.#height })}
        <button data-action="goto" class=${this.#station.picking ? 'on' : ''} title="click the goal; the height is set here"
          disabled=${none} onclick=${() => this.#goto()}>Go to…</button>
        ${act('hold', 'Hold', 'hold the position')}
        ${act('land', 'Land', 'land here')}
        ${act('rtl', 'Return', 'return home and land')}
        ${act('disarm', 'Disarm', 'disarm on the ground')}
        <button data-action="kill" class="danger" title="stop the motors immediately" disabled=${none}
          onclick=${() => this.#kill()}>Kill…</button></div>
      <div class="row"><select value=${this.#mode} onchange=${(event) => { this.#mode = event.target.value; }}>
          ${MODES.map((mode) => html`<option value=${mode}>${mode}</option>`)}</select>
        <button data-action="mode" disabled=${none} onclick=${() => this.#command({ action: 'mode', mode: this.#mode })}>Set mode</button>
        <button data-action="reset" disabled=${none} title="reset to the start pose, rebooted"
          onclick=${() => this.#reset()}>Reset</button></div></div>`;
  }

  async #reset() {
    for (const vehicle of this.#station.selection.names) {
      await this.#station.call('time.reset', { vehicle }).then(toast, (error) => toast(error.message, 'bad'));
    }
  }

  #list(rows) {
    const gaps = nearest(rows);
    const { roster, selection } = this.#station;
    return html`<div style="overflow-x:auto"><table><thead><tr><th>vehicle</th><th>mode</th><th>state</th><th class="num">height m</th>
      <th class="num">m/s</th><th class="num">nearest m</th><th class="num">battery</th><th>link</th><th>estimator</th></tr></thead><tbody>
      ${roster.vehicles.map(({ name }, i) => {
        const row = rows.subarray(i * COLUMNS, (i + 1) * COLUMNS);
        return html`<tr key=${name} data-vehicle=${name} class=${selection.has(name) ? 'selected' : ''}
            onclick=${() => selection.toggle(name)}>
          <td>${name}</td>${this.#state(name)}
          <td class="num">${number(row[2])}</td><td class="num">${number(Math.hypot(row[7], row[8], row[9]))}</td>
          <td class=${`num ${gaps[i] < NEAR ? 'bad' : ''}`}>${number(gaps[i])}</td>${this.#health(name)}</tr>`;
      })}</tbody></table></div>`;
  }

  #state(name) {
    const status = this.#station.status.vehicles[name];
    if (!status) return html`<td>–</td><td>–</td>`;
    const findings = status.findings.filter(({ what }) => what !== 'OFFBOARD');
    const [kind, text] = status.armed ? ['good', 'armed'] : findings.length ? ['warn', 'not ready'] : ['', 'ready'];
    return html`<td data-cell="mode">${status.mode || '–'}</td><td data-cell="state"><span class=${`pill ${kind}`}>${text}</span></td>`;
  }

  #health(name) {
    const status = this.#station.status.vehicles[name];
    if (!status) return html`<td class="num">–</td><td>–</td><td>–</td>`;
    const { battery, link, estimator } = status;
    return html`<td class=${`num ${battery !== null && battery < LOW_BATTERY ? 'bad' : ''}`}>
        ${battery === null ? '–' : `${Math.round(100 * battery)} %`}</td>
      <td class=${link ? 'good' : 'bad'}>${link ? 'ok' : 'none'}</td>
      <td class=${estimator?.length ? 'bad' : 'good'}>${estimator === null ? '–' : estimator.length ? `no ${estimator.join(', ')}` : 'ok'}</td>`;
  }

  /** Lists what keeps vehicles from flying, equal findings once; what concerns OFFBOARD alone is folded. */
  #findings() {
    const { status, selection, roster } = this.#station;
    const found = new Map();
    for (const { name } of roster.vehicles) {
      if (selection.size && !selection.has(name)) continue;
      for (const finding of status.vehicles[name]?.findings ?? []) {
        const key = `${finding.what} ${finding.text.replaceAll(name, '')}`;
        if (!found.has(key)) found.set(key, { ...finding, names: [] });
        found.get(key).names.push(name);
      }
    }
    const all = [...found.values()];
    const offboard = all.filter(({ what }) => what === 'OFFBOARD');
    return html`<div style="margin-top:10px">${status.trouble ? html`<div class="card bad">${status.trouble}</div>` : null}
      ${all.filter(({ what }) => what !== 'OFFBOARD').map(card)}
      ${offboard.length ? html`<details><summary class="soft">what OFFBOARD needs (${offboard.length})</summary>${offboard.map(card)}</details>` : null}</div>`;
  }
}

const card = ({ what, text, remedy, names }) => html`<div class="card" data-finding=${what}>
  <b>${names.slice(0, 5).join(', ')}${names.length > 5 ? ` and ${names.length - 5} more` : ''}</b> <span class="pill warn">${what}</span>
  <div>${text}</div><div class="soft">→ ${remedy}</div></div>`;

function mount(element, station) {
  const table = new Table(element, station);
  return () => table.end();
}

export const panel = { name: 'vehicles', title: 'Vehicles', icon: '☰', mount };
