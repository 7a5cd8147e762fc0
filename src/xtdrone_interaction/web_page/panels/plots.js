// Plots as rqt_plot: numeric fields of any topic over time, several in one axis and several axes; pause, zoom, CSV.
import uPlot from '../vendor/uplot.js';
import { html, render } from '../vendor/preact_htm.js';
import { toast } from '../station.js';
import { NO_PUBLISHER, Subscription, matching, save } from '../topic_choice.js';

const COLOURS = ['#2f7de1', '#e1632f', '#2fa84f', '#a44fd1', '#d1a11e', '#1fb5b5', '#d13f7b', '#7a8697'];
const WINDOWS = [5, 10, 30, 60, 300]; // s
const KEPT = 60000; // samples of a curve
const RESET = 1; // s by which time goes back at least; stamps of one topic may be out of order by less
const DRAW_PERIOD = 100; // ms
const HEIGHT = 230; // px of one axis
const STORED = 'xtdrone-plots';
const EXAMPLES = 12; // topics offered in the list

/** One curve: its subscription and its samples. */
class Curve {
  t = [];
  v = [];
  fault = '';
  gone = false; // no node publishes the topic
  constructor(station, topic, field, colour, changed) {
    Object.assign(this, { topic, field, colour, label: `${topic}/${field}` });
    this.subscription = new Subscription(station, 'plots.open', { topic, field }, 'plots.close', (error) => {
      this.fault = error.message;
      changed();
    }, () => { this.fault = ''; changed(); });
  }

  /** Adds samples; tells whether their time has gone back, as it does when the simulation is reset. */
  add(t, v) {
    let from = -1; // of the last sample after which time has gone back
    for (let i = 0; i < t.length; i++) if (t[i] < (i ? t[i - 1] : this.t.at(-1) ?? t[0]) - RESET) from = i;
    if (from >= 0) this.clear();
    this.t.push(...t.slice(Math.max(from, 0)));
    this.v.push(...v.slice(Math.max(from, 0)));
    if (this.t.length > 1.2 * KEPT) {
      this.t.splice(0, this.t.length - KEPT);
      this.v.splice(0, this.v.length - KEPT);
    }
    return from >= 0;
  }

  get trouble() {
    return this.fault || (this.gone ? NO_PUBLISHER : this.v.at(-1) === null ? 'not a finite number now' : '');
  }

  clear() { this.t = []; this.v = []; }
}

/** Joins curves on one time axis as uPlot wants it; samples of other times become gaps that are drawn through. */
export function joined(curves) {
  const tables = curves.map(({ t, v }) => [t, v]).filter(([t]) => t.length);
  if (!tables.length) return [[], ...curves.map(() => [])];
  const times = [...new Set(tables.flatMap(([t]) => t))].sort((a, b) => a - b);
  const place = new Map(times.map((time, i) => [time, i]));
  return [times, ...curves.map(({ t, v }) => {
    const column = new Array(times.length).fill(undefined);
    t.forEach((time, i) => { column[place.get(time)] = v[i]; });
    return column;
  })];
}

function mount(element, station) {
  const axes = []; // each {curves, plot, holder}
  const state = { window: 30, paused: false, topics: [], topic: '', fields: [], words: '', axis: 0, zoomed: false };
  const controls = document.createElement('div');
  const plots = document.createElement('div');
  element.append(controls, plots);

  const remember = () => {
    const wanted = axes.map(({ curves }) => curves.map(({ topic, field }) => [topic, field]));
    try { localStorage.setItem(STORED, JSON.stringify(wanted)); } catch { /* a private window has none */ }
  };

  const style = (name) => getComputedStyle(element).getPropertyValue(name).trim();

  const makePlot = (axis) => {
    axis.plot?.destroy();
    axis.plot = null;
    if (!axis.curves.length) return;
    const grid = { stroke: style('--line'), width: 1 };
    const side = { stroke: style('--soft'), grid, ticks: grid };
    axis.plot = new uPlot({
      width: Math.max(axis.holder.clientWidth - 20, 240),
      height: HEIGHT,
      cursor: { sync: { key: 'plots' }, drag: { x: true, y: true, uni: 30 } },
      legend: { live: true },
      scales: { x: { time: false } },
      axes: [{ ...side, label: undefined, values: (_, ticks) => ticks.map((tick) => `${+tick.toFixed(3)} s`) }, { ...side, size: 62 }],
      series: [{ label: 'time s', value: (_, value) => (value == null ? '–' : value.toFixed(3)) }, ...axis.curves.map((curve) => ({
        label: curve.label, stroke: curve.colour, width: 1.6, spanGaps: true, points: { show: false },
        value: (_, value) => (value == null ? '–' : value.toPrecision(6)),
      }))],
      hooks: { setSelect: [(plot) => { if (plot.select.width > 0) { state.zoomed = true; drawControls(); } }] },
    }, joined(axis.curves), axis.holder);
    axis.plot.over.addEventListener('dblclick', () => { state.zoomed = false; update(true); drawControls(); });
  };

  const update = (always = false) => {
    if (state.paused && !always) return;
    const newest = Math.max(...axes.flatMap(({ curves }) => curves.map(({ t }) => t.at(-1) ?? -Infinity)));
    for (const axis of axes) {
      if (!axis.plot) continue;
      const shown = state.paused || state.zoomed ? axis.curves : axis.curves.map((curve) => cut(curve, newest - state.window));
      axis.plot.setData(joined(shown), !state.zoomed);
      if (!state.zoomed && !state.paused && Number.isFinite(newest)) {
        axis.plot.setScale('x', { min: newest - state.window, max: newest });
      }
    }
  };

  const cut = ({ t, v }, from) => {
    let low = 0;
    let high = t.length;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (t[middle] < from) low = middle + 1; else high = middle;
    }
    return { t: t.slice(low), v: v.slice(low) };
  };

  const addAxis = () => {
    const holder = document.createElement('div');
    holder.className = 'card plot';
    plots.append(holder);
    axes.push({ curves: [], plot: null, holder });
    state.axis = axes.length - 1;
  };

  const addCurve = (topic, field, axis = state.axis) => {
    if (!topic || !field) return;
    while (axes.length <= axis) addAxis();
    const { curves } = axes[axis];
    if (curves.some((curve) => curve.topic === topic && curve.field === field)) return;
    const used = new Set(curves.map(({ colour }) => colour));
    const colour = COLOURS.find((c) => !used.has(c)) ?? COLOURS[curves.length % COLOURS.length];
    curves.push(new Curve(station, topic, field, colour, drawControls));
    makePlot(axes[axis]);
    remember();
    drawControls();
  };

  const removeCurve = (axis, curve) => {
    curve.subscription.close();
    axis.curves = axis.curves.filter((other) => other !== curve);
    if (axis.curves.length || axes.length === 1) makePlot(axis);
    else {
      axis.plot?.destroy();
      axis.holder.remove();
      axes.splice(axes.indexOf(axis), 1);
      state.axis = Math.min(state.axis, axes.length - 1);
    }
    remember();
    drawControls();
  };

  const choose = async (topic) => {
    Object.assign(state, { topic, words: topic, fields: [] });
    drawControls();
    try {
      const { fields } = await station.call('topics.fields', { topic });
      state.fields = fields.filter(({ plottable }) => plottable);
    } catch (error) { toast(error.message, 'bad'); }
    drawControls();
  };

  const exportCsv = () => {
    const curves = axes.flatMap((axis) => axis.curves);
    const [times, ...columns] = joined(curves);
    const lines = times.map((time, i) => [time, ...columns.map((column) => column[i] ?? '')].join(','));
    save('plots.csv', [['time_s', ...curves.map(({ label }) => label)].join(','), ...lines].join('\n'));
  };

  const chips = () => axes.map((axis, i) => html`<div class="row"><button class=${`quiet ${i === state.axis ? 'on' : ''}`}
      title="new curves are added here" onclick=${() => { state.axis = i; drawControls(); }}>Axis ${i + 1}</button>
    ${axis.curves.map((curve) => html`<span class="pill" data-curve=${curve.label} title=${curve.trouble}>
      <b style=${`color:${curve.colour}`}>●</b> <span class="mono">${curve.label}</span>
      ${curve.trouble ? html`<span class="bad" data-role="trouble"> ${curve.trouble}</span>` : ''}
      <button class="quiet small" title="remove" onclick=${() => removeCurve(axis, curve)}>✕</button></span>`)}</div>`);

  const chooser = () => {
    const offered = state.words && state.words !== state.topic ? matching(state.topics, state.words).slice(0, EXAMPLES) : [];
    return html`<div class="row"><input class="mono" type="search" style="flex:2" placeholder="topic" value=${state.words}
        oninput=${(event) => { state.words = event.target.value; state.topic = ''; state.fields = []; drawControls(); }}
        onchange=${(event) => { if (state.topics.some(({ name }) => name === event.target.value)) choose(event.target.value); }}/>
      ${state.fields.length ? html`<input class="mono" list="plot-fields" style="flex:1" placeholder="field" data-role="field"
        onchange=${(event) => { if (event.target.value) addCurve(state.topic, event.target.value); event.target.value = ''; }}/>
        <datalist id="plot-fields">${state.fields.map(({ path }) => html`<option value=${path.replaceAll('[]', '[0]')}/>`)}</datalist>` : ''}</div>
      ${offered.map(({ name, type }) => html`<div class="link mono" onclick=${() => choose(name)}>${name} <span class="soft">${type}</span></div>`)}
      ${state.fields.length ? html`<div class="row">${state.fields.slice(0, 40).map(({ path }) => html`<button class="small mono"
        onclick=${() => addCurve(state.topic, path.replaceAll('[]', '[0]'))}>${path}</button>`)}</div>` : ''}`;
  };

  function drawControls() {
    render(html`${chooser()}<div class="row">
      <button class=${state.paused ? 'on' : ''} onclick=${() => { state.paused = !state.paused; update(true); drawControls(); }}>Pause</button>
      <select title="time span" onchange=${(event) => { state.window = Number(event.target.value); update(true); }}>
        ${WINDOWS.map((seconds) => html`<option value=${seconds} selected=${seconds === state.window}>last ${seconds} s</option>`)}</select>
      <button disabled=${!state.zoomed} onclick=${() => { state.zoomed = false; update(true); drawControls(); }}>Whole</button>
      <button onclick=${() => { addAxis(); drawControls(); }}>New axis</button>
      <button onclick=${() => { axes.forEach(({ curves }) => curves.forEach((curve) => curve.clear())); update(true); }}>Clear</button>
      <button onclick=${exportCsv}>CSV</button></div>${chips()}
      <p class="soft">Drag to zoom, double-click for the full range. Times are the messages' stamps.</p>`, controls);
  }

  const list = () => station.call('topics.list').then(({ topics }) => {
    state.topics = topics;
    const published = new Set(topics.filter(({ publishers }) => publishers.length).map(({ name }) => name));
    const changed = all().filter((curve) => curve.gone === published.has(curve.topic));
    changed.forEach((curve) => { curve.gone = !curve.gone; });
    all().filter(({ topic }) => published.has(topic)).forEach((curve) => curve.subscription.retry());
    if (changed.length || state.words !== state.topic) drawControls(); // what is typed may match now
  }, () => {});
  const all = () => axes.flatMap((axis) => axis.curves);
  const rebuild = () => axes.forEach(makePlot);
  /** Clears the curves that end later than a time, which are those of the flight before a reset. */
  const restart = (time) => {
    all().filter((curve) => curve.t.at(-1) > time + RESET).forEach((curve) => curve.clear());
    if (state.zoomed) { state.zoomed = false; drawControls(); }
  };
  const offs = [
    station.onConnect(list),
    station.on('plots.samples', (samples) => {
      for (const curve of all()) {
        const own = samples[curve.subscription.number];
        if (own) {
          const before = curve.trouble;
          curve.fault = '';
          if (curve.add(own.t, own.v)) restart(own.t.at(-1));
          if (curve.trouble !== before) drawControls();
        }
      }
    }),
    station.on('plots.fault', ({ subscription, text }) => {
      for (const curve of all()) if (curve.subscription.number === subscription) curve.fault = text;
      drawControls();
    }),
    station.on('station.theme', () => requestAnimationFrame(rebuild)),
  ];
  const timers = [setInterval(update, DRAW_PERIOD), setInterval(list, 5000)];
  const resizing = new ResizeObserver(() => axes.forEach(({ plot, holder }) => plot?.setSize({ width: Math.max(holder.clientWidth - 20, 240), height: HEIGHT })));
  resizing.observe(plots);
  addAxis();
  let stored = [];
  try { stored = JSON.parse(localStorage.getItem(STORED)) ?? []; } catch { /* another version's */ }
  stored.forEach((curves, i) => curves.forEach(([topic, field]) => addCurve(topic, field, i)));
  drawControls();
  return () => {
    timers.forEach(clearInterval);
    offs.forEach((off) => off());
    resizing.disconnect();
    all().forEach((curve) => curve.subscription.close());
    axes.forEach(({ plot }) => plot?.destroy());
    element.replaceChildren();
  };
}

export const panel = { name: 'plots', title: 'Plots', icon: '∿', mount };
