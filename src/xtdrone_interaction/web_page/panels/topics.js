// Topics as rqt_topic shows them: list with rates on request, echo of one, a message published by hand.
import { html, render } from '../vendor/preact_htm.js';
import { toast } from '../station.js';
import { NO_PUBLISHER, Subscription, bytes, matching, rate } from '../topic_choice.js';

const LIST_PERIOD = 3000; // ms
const RATE_PERIOD = 1000;
const SHOWN = 250; // rows; more are found by the filter

function mount(element, station) {
  const state = { topics: [], words: '', rates: {}, topic: null, latest: null, error: '', paused: false, publishing: null };
  const measured = new Map(); // topic -> subscription that measures its rate
  let echo = null;

  const toggleRate = (name) => {
    if (measured.has(name)) {
      measured.get(name).close();
      measured.delete(name);
    } else {
      measured.set(name, new Subscription(station, 'topics.measure', { topic: name }, 'topics.close',
        (error) => toast(error.message, 'bad')));
    }
    draw();
  };

  const select = (name) => {
    echo?.close();
    Object.assign(state, { topic: name, latest: null, error: '', publishing: null });
    echo = name && new Subscription(station, 'topics.echo', { topic: name, rate: 5 }, 'topics.close',
      (error) => { state.error = error.message; draw(); }, () => { state.error = ''; draw(); });
    draw();
  };

  const beginPublishing = async () => {
    const { type } = state.topics.find(({ name }) => name === state.topic) ?? {};
    const text = JSON.stringify(state.latest?.message ?? {}, null, 1);
    state.publishing = { type: type === '*' ? '' : type, text };
    draw();
  };

  const publish = async () => {
    const { type, text } = state.publishing;
    try {
      const { subscribers } = await station.call('topics.publish', { topic: state.topic, type, message: JSON.parse(text) });
      toast(`published on ${state.topic} to ${subscribers} subscriber${subscribers === 1 ? '' : 's'}`);
    } catch (error) { toast(error.message, 'bad'); }
  };

  const row = ({ name, type, publishers, subscribers }) => {
    const known = state.rates[name];
    return html`<tr key=${name} class=${name === state.topic ? 'selected' : ''} data-topic=${name}>
      <td><input type="checkbox" title="measure the rate" checked=${measured.has(name)} onchange=${() => toggleRate(name)}/></td>
      <td class="mono link text" title=${`from ${publishers.join(', ') || 'no node'}\nto ${subscribers.join(', ') || 'no node'}`}
        onclick=${() => select(name)}>${name}<div class="soft type">${type}</div></td>
      <td class="num">${measured.has(name) && known ? rate(known.rate) : ''}</td>
      <td class="num">${measured.has(name) && known ? bytes(known.bytes) : ''}</td></tr>`;
  };

  const gone = () => state.topics.length > 0 && !state.topics.some(({ name, publishers }) => name === state.topic && publishers.length);

  const message = () => {
    const { latest, error } = state;
    if (error) return html`<p class="bad">${error}</p>`;
    if (!latest) return html`<p class="soft">No message yet.</p>`;
    if (latest.error) return html`<p class="bad">${latest.error}</p>`;
    return html`<p class="soft">${latest.publisher}, ${latest.type}, ${bytes(latest.size)}, ${latest.time.toFixed(3)} s</p>
      <pre class="mono echo" data-role="echo">${inYaml(latest.message)}</pre>`;
  };

  const publisher = () => html`<div class="card operate">
    <div class="row"><b>Publish</b><input class="mono" value=${state.publishing.type} placeholder="std_msgs/String"
      oninput=${(event) => { state.publishing.type = event.target.value; }}/>
      <button class="primary" onclick=${publish}>Send</button>
      <button onclick=${() => { state.publishing = null; draw(); }}>Close</button></div>
    <textarea class="mono" rows="8" style="width:100%" value=${state.publishing.text}
      oninput=${(event) => { state.publishing.text = event.target.value; }}></textarea></div>`;

  const echoCard = () => html`<div class="card"><div class="row"><b class="mono">${state.topic}</b><span class="grow"></span>
      <button class=${state.paused ? 'on' : ''} onclick=${() => { state.paused = !state.paused; draw(); }}>Pause</button>
      <button class="operate" onclick=${beginPublishing}>Publish…</button>
      <button onclick=${() => select(null)}>Close</button></div>
      ${state.publishing ? publisher() : ''}
      ${gone() ? html`<p class="warn" data-role="gone">${NO_PUBLISHER}</p>` : ''}${message()}</div>`;

  function draw() {
    const found = matching(state.topics, state.words);
    render(html`<div class="row"><input type="search" placeholder="filter by name or type" value=${state.words} style="flex:1"
        oninput=${(event) => { state.words = event.target.value; draw(); }}/>
        <span class="soft">${found.length} of ${state.topics.length}</span></div>
      ${state.topic ? echoCard() : ''}
      <table><thead><tr><th></th><th>topic</th><th class="num">Hz</th><th class="num">per s</th></tr></thead>
        <tbody>${found.slice(0, SHOWN).map(row)}</tbody></table>
      ${found.length > SHOWN ? html`<p class="soft">${found.length - SHOWN} more: narrow the filter.</p>` : ''}`, element);
  }

  const list = () => station.call('topics.list').then(({ topics }) => { state.topics = topics; draw(); }, () => {});
  const readRates = () => {
    if (measured.size) station.call('topics.rates').then((rates) => { state.rates = rates; draw(); }, () => {});
  };
  const offs = [
    station.onConnect(list),
    station.on('topics.message', (data) => {
      if (data.subscription !== echo?.number || state.paused) return;
      state.latest = data;
      draw();
    }),
  ];
  const timers = [setInterval(list, LIST_PERIOD), setInterval(readRates, RATE_PERIOD)];
  draw();
  return () => {
    timers.forEach(clearInterval);
    offs.forEach((off) => off());
    echo?.close();
    measured.forEach((subscription) => subscription.close());
    render(null, element);
  };
}

/** Writes a message as rostopic echo does. */
export function inYaml(value, indent = '') {
  if (Array.isArray(value)) {
    if (value.every((entry) => entry === null || typeof entry !== 'object')) return `[${value.map(single).join(', ')}]`;
    return value.map((entry) => `\n${indent}- ${inYaml(entry, `${indent}  `).replace(/^\n\s*/, '')}`).join('');
  }
  if (value !== null && typeof value === 'object') {
    if (isTime(value)) return `${value.secs}.${String(value.nsecs).padStart(9, '0')}`;
    if (isShortened(value)) return `${value.length} elements, first ${inYaml(value.first, indent)}`;
    return Object.entries(value).map(([name, entry]) => `\n${indent}${name}: ${inYaml(entry, `${indent}  `)}`).join('')
      .slice(indent ? 0 : 1);
  }
  return single(value);
}

const single = (value) => (typeof value === 'string' ? JSON.stringify(value) : String(value));
const isTime = (value) => 'secs' in value && 'nsecs' in value && Object.keys(value).length === 2;
const isShortened = (value) => 'length' in value && 'first' in value && Object.keys(value).length === 2;

export const panel = { name: 'topics', title: 'Topics', icon: '≣', mount };
