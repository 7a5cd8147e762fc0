// Node graph as rqt_graph: nodes, the topics between them, their rates, and who takes part in the lockstep.
import { html, render } from '../vendor/preact_htm.js';
import { toast } from '../station.js';
import { Subscription, bytes, rate } from '../topic_choice.js';

const PERIOD = 4000; // ms
const BOX = { width: 190, height: 30, gapX: 90, gapY: 14 };
const MOST_MEASURED = 20; // topics of a link whose rates are measured

/** Joins nodes whose names differ in numbers only, as /iris_0_follower and /iris_1_follower. */
export function grouped(graph, joins) {
  const nameOf = (name) => (joins ? name.replace(/\d+/g, '#') : name);
  const nodes = new Map();
  for (const node of graph.nodes) {
    const name = nameOf(node.name);
    const group = nodes.get(name) ?? { name, members: [], participant: false, waited: false };
    group.members.push(node.name);
    group.participant ||= node.participant;
    group.waited ||= node.waited;
    nodes.set(name, group);
  }
  const links = new Map();
  for (const link of graph.links) {
    const [from, to] = [nameOf(link.from), nameOf(link.to)];
    if (from === to) continue;
    const key = `${from} ${to}`;
    const joined = links.get(key) ?? { from, to, topics: new Set() };
    link.topics.forEach((topic) => joined.topics.add(topic));
    links.set(key, joined);
  }
  return { nodes: [...nodes.values()], links: [...links.values()] };
}

/** Places nodes in columns by their distance from the one that sends to most; returns name -> {x, y}. */
export function placed({ nodes, links }) {
  const out = new Map(nodes.map(({ name }) => [name, links.filter((link) => link.from === name).map((link) => link.to)]));
  const order = nodes.map(({ name }) => name).sort((a, b) => out.get(b).length - out.get(a).length || (a < b ? -1 : 1));
  const column = new Map();
  for (const start of order) {
    if (column.has(start)) continue;
    column.set(start, 0);
    for (const queue = [start]; queue.length;) {
      const name = queue.shift();
      for (const next of [...out.get(name)].sort()) {
        if (!column.has(next)) { column.set(next, column.get(name) + 1); queue.push(next); }
      }
    }
  }
  const rows = [];
  const places = new Map();
  for (const name of nodes.map((node) => node.name).sort()) {
    const x = column.get(name);
    rows[x] = (rows[x] ?? 0) + 1;
    places.set(name, { x: x * (BOX.width + BOX.gapX), y: (rows[x] - 1) * (BOX.height + BOX.gapY) });
  }
  return places;
}

function mount(element, station) {
  const state = { graph: { nodes: [], links: [], services: {} }, joins: true, hidden: true, selected: null, link: null, rates: {} };
  let measured = [];

  const shown = () => {
    const graph = grouped(state.graph, state.joins);
    if (!state.hidden) return graph;
    const quiet = (name) => ['/rosout', station_name].includes(name) || name.startsWith('/rosbag');
    return { nodes: graph.nodes.filter(({ name }) => !quiet(name)), links: graph.links.filter(({ from, to }) => !quiet(from) && !quiet(to)) };
  };
  const station_name = '/web_station';

  const measure = (topics) => {
    measured.forEach((subscription) => subscription.close());
    measured = topics.slice(0, MOST_MEASURED).map((topic) => new Subscription(station, 'topics.measure', { topic },
      'topics.close', (error) => toast(error.message, 'bad')));
  };

  const selectLink = (link) => {
    state.link = link;
    state.selected = null;
    measure([...link.topics].sort());
    draw();
  };

  const selectNode = (name) => {
    state.selected = state.selected === name ? null : name;
    state.link = null;
    measure([]);
    draw();
  };

  const details = (graph) => {
    if (state.link) {
      const topics = [...state.link.topics].sort();
      return html`<div class="card"><b class="mono">${state.link.from} → ${state.link.to}</b>
        <table><thead><tr><th>topic</th><th class="num">Hz</th><th class="num">per s</th></tr></thead><tbody>
        ${topics.map((topic) => html`<tr key=${topic}><td class="mono text">${topic}</td><td class="num">${rate(state.rates[topic]?.rate)}</td>
          <td class="num">${bytes(state.rates[topic]?.bytes)}</td></tr>`)}</tbody></table>
        ${topics.length > MOST_MEASURED ? html`<p class="soft">Rates of the first ${MOST_MEASURED}.</p>` : ''}</div>`;
    }
    const node = graph.nodes.find(({ name }) => name === state.selected);
    if (!node) return html`<p class="soft">Click a node or a line. Blue frames: lockstep participants.</p>`;
    const services = Object.entries(state.graph.services).filter(([, names]) => names.some((name) => node.members.includes(name)));
    return html`<div class="card"><b class="mono">${node.name}</b> ${node.participant ? html`<span class="pill good">lockstep</span>` : ''}
      ${node.members.length > 1 ? html`<p class="soft">${node.members.join(', ')}</p>` : ''}
      <p>from ${graph.links.filter(({ to }) => to === node.name).map(({ from }) => from).join(', ') || 'none'};
        to ${graph.links.filter(({ from }) => from === node.name).map(({ to }) => to).join(', ') || 'none'}</p>
      <details><summary>${services.length} services</summary><p class="mono text">${services.map(([name]) => name).join(' ')}</p></details></div>`;
  };

  const line = (link, places) => {
    const [a, b] = [places.get(link.from), places.get(link.to)];
    if (!a || !b) return null;
    const forward = b.x > a.x;
    const [x1, y1] = [a.x + (forward ? BOX.width : 0), a.y + BOX.height / 2];
    const [x2, y2] = [b.x + (forward ? 0 : BOX.width), b.y + BOX.height / 2];
    const bend = forward ? BOX.gapX / 2 : -BOX.gapX / 2;
    const near = state.selected && (link.from === state.selected || link.to === state.selected);
    const on = near || (state.link && state.link.from === link.from && state.link.to === link.to);
    return html`<g class=${`edge ${on ? 'on' : ''} ${state.selected && !near ? 'faint' : ''}`} onclick=${() => selectLink(link)}>
      <title>${link.from} → ${link.to}: ${[...link.topics].slice(0, 12).join(', ')}${link.topics.size > 12 ? ' …' : ''}</title>
      <path class="hit" d=${`M${x1},${y1} C${x1 + bend},${y1} ${x2 - bend},${y2} ${x2},${y2}`}/>
      <path d=${`M${x1},${y1} C${x1 + bend},${y1} ${x2 - bend},${y2} ${x2},${y2}`} marker-end="url(#arrow)"/>
      ${on ? html`<text x=${(x1 + x2) / 2} y=${(y1 + y2) / 2 - 4} text-anchor="middle">${link.topics.size}</text>` : ''}</g>`;
  };

  const box = (node, { x, y }) => html`<g data-node=${node.name} transform=${`translate(${x},${y})`} onclick=${() => selectNode(node.name)}
      class=${`node ${node.participant ? 'participant' : ''} ${node.waited ? 'waited' : ''} ${node.name === state.selected ? 'on' : ''}`}>
    <title>${node.members.join('\n')}${node.participant ? '\nparticipant of the lockstep' : ''}</title>
    <rect width=${BOX.width} height=${BOX.height} rx="8"/>
    <text x=${BOX.width / 2} y=${BOX.height / 2 + 5} text-anchor="middle">${short(node.name)}${node.members.length > 1 ? ` ×${node.members.length}` : ''}</text></g>`;

  function draw() {
    const graph = shown();
    const places = placed(graph);
    const width = Math.max(...[...places.values()].map(({ x }) => x), 0) + BOX.width + 4;
    const height = Math.max(...[...places.values()].map(({ y }) => y), 0) + BOX.height + 4;
    render(html`<div class="row"><label><input type="checkbox" checked=${state.joins} onchange=${() => { state.joins = !state.joins; state.selected = null; draw(); }}/>
        alike nodes as one</label>
      <label><input type="checkbox" checked=${state.hidden} onchange=${() => { state.hidden = !state.hidden; draw(); }}/> without rosout and this station</label>
      <span class="soft">${graph.nodes.length} nodes, ${graph.links.length} line${graph.links.length === 1 ? '' : 's'}</span></div>
      ${details(graph)}
      <div class="graph"><svg width=${width} height=${height} viewBox=${`-2 -2 ${width} ${height}`}><defs><marker id="arrow" viewBox="0 0 8 8"
        refX="8" refY="4" markerWidth="7" markerHeight="7" orient="auto"><path d="M0,0 L8,4 L0,8 z"/></marker></defs>
      ${graph.links.map((link) => line(link, places))}${graph.nodes.map((node) => box(node, places.get(node.name)))}</svg></div>`, element);
  }

  const read = () => station.call('graph.read').then((graph) => { state.graph = graph; draw(); }, () => {});
  const readRates = () => {
    if (measured.length) station.call('topics.rates').then((rates) => { state.rates = rates; draw(); }, () => {});
  };
  const off = station.onConnect(read);
  const timers = [setInterval(read, PERIOD), setInterval(readRates, 1000)];
  draw();
  return () => {
    off();
    timers.forEach(clearInterval);
    measure([]);
    render(null, element);
  };
}

const short = (name) => (name.length > 24 ? `${name.slice(0, 11)}…${name.slice(-12)}` : name);

export const panel = { name: 'nodes', title: 'Nodes', icon: '⇄', mount };
