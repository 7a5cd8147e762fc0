// Parameters of ROS, and of the vehicles' autopilots with PX4's ranges and units; searched and set.
import { html, render } from '../vendor/preact_htm.js';
import { toast } from '../station.js';

const SHOWN = 150; // rows; more are found by the filter

function mount(element, station) {
  const state = { kind: 'vehicle', vehicle: '', words: '', changed: false, effect: true, ros: { values: {}, declared: {} }, definitions: {},
    values: {}, edited: null, text: '', busy: false };

  const fail = (error) => toast(error.message, 'bad');

  const readRos = () => station.call('parameters.ros').then((ros) => { state.ros = ros; draw(); }, fail);

  const readVehicle = async () => {
    state.vehicle ||= station.selection.names[0] ?? station.roster.vehicles[0]?.name ?? '';
    if (!state.vehicle) return;
    try {
      if (!Object.keys(state.definitions).length) state.definitions = await station.call('parameters.definitions');
      ({ values: state.values } = await station.call('parameters.vehicle', { vehicle: state.vehicle }));
    } catch (error) { fail(error); }
    draw();
  };

  const pull = async () => {
    state.busy = true;
    draw();
    try { ({ values: state.values } = await station.call('parameters.pull', { vehicle: state.vehicle })); } catch (error) { fail(error); }
    state.busy = false;
    draw();
  };

  const read = () => (state.kind === 'ros' ? readRos() : readVehicle());

  const edit = (name, value) => {
    if (station.role !== 'operate') return;
    state.edited = name;
    state.text = typeof value === 'string' ? value : JSON.stringify(value);
    draw();
    element.querySelector('[data-role=value]')?.select?.();
  };

  const set = async () => {
    const { edited, text, vehicle } = state;
    try {
      if (state.kind === 'ros') {
        await station.call('parameters.set_ros', { name: edited, value: valueOf(text, state.ros.values[edited]) });
        await readRos();
        toast(`${edited} is set; nodes read it when they start, unless they say otherwise`);
      } else {
        const { value } = await station.call('parameters.set_vehicle', { vehicle, name: edited, value: Number(text) });
        state.values[edited] = value;
        toast(`${vehicle} ${edited} is ${value}`);
      }
      state.edited = null;
    } catch (error) { fail(error); }
    draw();
  };

  const editor = (choices) => html`<span class="row" style="margin:0">${choices
    ? html`<select data-role="value" onchange=${(event) => { state.text = event.target.value; }}>${choices.map(({ value, description }) =>
      html`<option value=${value} selected=${String(value) === state.text}>${value}: ${description}</option>`)}</select>`
    : html`<input data-role="value" class="mono" value=${state.text} oninput=${(event) => { state.text = event.target.value; }}
      onkeydown=${(event) => { if (event.key === 'Enter') set(); if (event.key === 'Escape') { state.edited = null; draw(); } }}/>`}
    <button class="primary small" data-role="set" onclick=${set}>Set</button>
    <button class="small" onclick=${() => { state.edited = null; draw(); }}>✕</button></span>`;

  const found = (entries) => {
    const words = state.words.toLowerCase().split(/\s+/).filter(Boolean);
    return entries.filter(({ name, about }) => words.every((word) => `${name} ${about}`.toLowerCase().includes(word)));
  };

  const rosRows = () => found(Object.entries(state.ros.values).map(([name, value]) => {
    const declared = state.ros.declared[name];
    return { name, value, about: declared?.meaning ?? '', range: declared?.range ?? '', unit: withUnit(declared) ? '' : declared?.unit ?? '', usual: declared?.default };
  }));

  const vehicleRows = () => found(Object.values(state.definitions).filter(({ category }) => !state.effect || category === 'Standard').map((d) => ({
    name: d.name, value: state.values[d.name], about: d.shortDesc, unit: d.units ?? '', group: d.group, usual: d.default, choices: d.values,
    range: 'min' in d && 'max' in d ? `${d.min} to ${d.max}` : 'min' in d ? `at least ${d.min}` : 'max' in d ? `at most ${d.max}` : '',
    other: state.values[d.name] !== undefined && Math.abs(state.values[d.name] - d.default) > 1e-6 * Math.max(1, Math.abs(d.default)),
  }))).filter(({ other }) => !state.changed || other);

  const shownValue = (row) => {
    if (row.value === undefined) return html`<span class="soft">${row.usual}?</span>`;
    const choice = row.choices?.find(({ value }) => value === row.value);
    const text = typeof row.value === 'object' ? JSON.stringify(row.value) : Number.isFinite(row.value) && !Number.isInteger(row.value)
      ? String(+row.value.toPrecision(7)) : String(row.value);
    return html`<span class=${row.other ? 'warn' : ''}>${text.slice(0, 120)}</span>${choice ? html` <span class="soft">${choice.description}</span>` : ''}`;
  };

  const row = (entry) => html`<tr key=${entry.name} data-parameter=${entry.name}>
    <td class="text"><span class="mono">${entry.name}</span><div class="soft">${entry.about}</div></td>
    <td class="text">${state.edited === entry.name ? editor(entry.choices) : html`<span class="link mono" onclick=${() => edit(entry.name, entry.value ?? entry.usual)}>
      ${shownValue(entry)}</span>`}</td>
    <td class="text soft">${entry.range} ${entry.unit}${entry.other ? html`<div>usually ${entry.usual}</div>` : ''}</td></tr>`;

  function draw() {
    const rows = state.kind === 'ros' ? rosRows() : vehicleRows();
    const known = Object.keys(state.values).length;
    render(html`<div class="row"><span class="group">
        <button class=${state.kind === 'vehicle' ? 'on' : ''} data-role="px4" onclick=${() => { state.kind = 'vehicle'; read(); }}>Vehicle</button>
        <button class=${state.kind === 'ros' ? 'on' : ''} data-role="ros" onclick=${() => { state.kind = 'ros'; read(); draw(); }}>ROS</button></span>
      ${state.kind === 'vehicle' ? html`<select onchange=${(event) => { state.vehicle = event.target.value; state.values = {}; readVehicle(); }}>
          ${station.roster.vehicles.map(({ name }) => html`<option value=${name} selected=${name === state.vehicle}>${name}</option>`)}</select>
        <button class="operate" data-role="pull" disabled=${state.busy} onclick=${pull}>${state.busy ? 'Reading…' : 'Read from vehicle'}</button>` : ''}
      <input type="search" placeholder="search name or meaning" value=${state.words} style="flex:1"
        oninput=${(event) => { state.words = event.target.value; draw(); }}/></div>
      ${state.kind === 'vehicle' ? html`<div class="row"><label><input type="checkbox" checked=${state.effect}
          onchange=${() => { state.effect = !state.effect; draw(); }}/> with effect in the simulation</label>
        <label><input type="checkbox" checked=${state.changed} onchange=${() => { state.changed = !state.changed; draw(); }}/> other than usual</label>
        <span class="soft">${known ? `${known} read` : 'none read: usual values with ?'}</span></div>` : ''}
      <table><thead><tr><th>parameter</th><th>value</th><th>allowed</th></tr></thead><tbody>${rows.slice(0, SHOWN).map(row)}</tbody></table>
      <p class="soft">${rows.length > SHOWN ? `${rows.length - SHOWN} more: narrow the search.` : `${rows.length} parameters.`}</p>`, element);
  }

  const offs = [station.onConnect(read), station.selection.onChange(() => {
    const [name] = station.selection.names;
    if (name && name !== state.vehicle && state.kind === 'vehicle') { state.vehicle = name; state.values = {}; readVehicle(); }
  })];
  draw();
  return () => { offs.forEach((off) => off()); render(null, element); };
}

/** Tells whether a declaration's range names its unit. */
const withUnit = ({ range = '', unit = '' } = {}) => range.endsWith(` ${unit}`);

/** Returns what the user typed as a value: a text stays one where the parameter was one, else JSON or text. */
export function valueOf(text, before) {
  if (typeof before === 'string') return text;
  try { return JSON.parse(text); } catch { return text; }
}

export const panel = { name: 'parameters', title: 'Parameters', icon: '⚙', mount };
