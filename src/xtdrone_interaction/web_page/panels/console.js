// Console as rqt_console: log messages of all nodes with levels and filters.
import { html, render } from '../vendor/preact_htm.js';
import { save } from '../topic_choice.js';

const LEVELS = ['debug', 'info', 'warn', 'error', 'fatal'];
const KEPT = 5000;
const SHOWN = 400;
const COLOURS = { debug: 'soft', info: '', warn: 'warn', error: 'bad', fatal: 'bad' };

function mount(element, station) {
  const state = { messages: [], least: 'info', words: '', node: '', paused: false, held: [], open: null,
    before: 0 }; // messages of earlier stations

  const last = () => (state.held.at(-1) ?? state.messages.at(-1))?.number ?? 0;

  const add = (messages) => {
    keep(messages.map((m) => ({ ...m, number: m.number + state.before })));
    draw();
  };

  const keep = (messages) => {
    (state.paused ? state.held : state.messages).push(...messages);
    state.held.splice(0, state.held.length - KEPT);
    state.messages.splice(0, state.messages.length - KEPT);
  };

  const shown = () => {
    const words = state.words.toLowerCase().split(/\s+/).filter(Boolean);
    const least = LEVELS.indexOf(state.least);
    return state.messages.filter((m) => LEVELS.indexOf(m.level) >= least && (!state.node || m.node === state.node)
      && words.every((word) => `${m.text} ${m.node} ${m.place}`.toLowerCase().includes(word)));
  };

  const pause = () => {
    state.paused = !state.paused;
    if (!state.paused) keep(state.held.splice(0));
    draw();
  };

  const export_ = () => {
    const quoted = (text) => `"${String(text).replaceAll('"', '""')}"`;
    const lines = shown().map((m) => [m.time.toFixed(3), m.level, m.node, quoted(m.text), quoted(m.place)].join(','));
    save('console.csv', ['time,level,node,text,place', ...lines].join('\n'));
  };

  const row = (m) => html`<tr key=${m.number} data-level=${m.level} onclick=${() => { state.open = state.open === m.number ? null : m.number; draw(); }}>
    <td class="num mono">${m.time.toFixed(2)}</td><td class=${COLOURS[m.level]}>${m.level}</td>
    <td class="text"><span class="soft">${m.node}</span> ${m.text}${state.open === m.number ? html`<div class="soft mono">${m.place}</div>` : ''}</td></tr>`;

  function draw() {
    const found = shown();
    const nodes = [...new Set(state.messages.map((m) => m.node))].sort();
    const counts = Object.fromEntries(LEVELS.map((level) => [level, state.messages.filter((m) => m.level === level).length]));
    render(html`<div class="row">
        <select title="minimum level" value=${state.least} onchange=${(event) => { state.least = event.target.value; draw(); }}>
          ${LEVELS.map((level) => html`<option value=${level} selected=${level === state.least}>${level} and above</option>`)}</select>
        <select title="node" onchange=${(event) => { state.node = event.target.value; draw(); }}>
          <option value="">all nodes</option>${nodes.map((node) => html`<option value=${node} selected=${node === state.node}>${node}</option>`)}</select>
        <input type="search" placeholder="filter" value=${state.words} style="flex:1"
          oninput=${(event) => { state.words = event.target.value; draw(); }}/>
        <button class=${state.paused ? 'on' : ''} onclick=${pause}>Pause${state.held.length ? ` (${state.held.length})` : ''}</button>
        <button onclick=${() => { state.messages = []; draw(); }}>Clear</button><button onclick=${export_}>CSV</button></div>
      <p class="soft">${found.length} of ${state.messages.length}; <span class="warn">${counts.warn} warnings</span>,
        <span class="bad"> ${counts.error + counts.fatal} errors</span>; newest first</p>
      <table><thead><tr><th class="num">time s</th><th>level</th><th>message</th></tr></thead>
        <tbody>${found.slice(-SHOWN).reverse().map(row)}</tbody></table>
      ${found.length > SHOWN ? html`<p class="soft">${found.length - SHOWN} older: narrow the filter or export.</p>` : ''}`, element);
  }

  const offs = [
    station.onConnect(() => station.call('console.open').then(({ messages }) => {
      if (station.restarted) state.before = last(); // its numbers begin again
      add(messages.filter((m) => m.number + state.before > last()));
    }, () => {})),
    station.on('console.messages', ({ messages }) => add(messages)),
  ];
  draw();
  return () => {
    offs.forEach((off) => off());
    station.call('console.close').catch(() => {});
    render(null, element);
  };
}

export const panel = { name: 'console', title: 'Console', icon: '❯', mount };
