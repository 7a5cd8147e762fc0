// Recordings: started and stopped; a bag, a flight log or an archive played with a time line in place of the flight.
import { html, render } from '../vendor/preact_htm.js';
import { COLUMNS } from '../fleet_frame.js';
import { toast } from '../station.js';
import { bytes } from '../topic_choice.js';

const HEADER = 24; // of the fleet's frame, see fleet_frame.js
const SPEEDS = [0.25, 0.5, 1, 2, 5, 10, 30];
const STATE_PERIOD = 1000; // ms
const LIST_PERIOD = 5000; // ms: demos and other programs record, too
const KINDS = { mode: '', armed: 'warn', command: '', text: 'soft' };
const EVENTS_SHOWN = 300;

/** Shows a number as people read it. */
const figure = (value) => (typeof value === 'number' ? (Number.isInteger(value) ? String(value) : value.toPrecision(4)) : String(value));

/** Packs rows as a frame of the fleet, as xtdrone_interaction/web/fleet/fleet_frame.py does. */
export function fleetFrame(rows, count, time, roster, number) {
  const buffer = new ArrayBuffer(HEADER + 4 * rows.length);
  const view = new DataView(buffer);
  view.setUint8(0, 1);
  view.setUint8(1, 1);
  view.setUint16(2, count, true);
  view.setFloat64(8, time, true);
  view.setUint32(16, roster, true);
  view.setUint32(20, number, true);
  new Float32Array(buffer, HEADER).set(rows);
  return buffer;
}

/** Row numbers are floats of base 64 text. */
export function rowsOf(text) {
  const raw = atob(text);
  const data = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) data[i] = raw.charCodeAt(i);
  return new Float32Array(data.buffer);
}

/** A recorded flight of which the frames arrive while it is shown. */
class Flight {
  constructor(file, about) {
    Object.assign(this, { file, ...about, loaded: 0, shown: new Map(), rows: new Float32Array(about.frames * about.vehicles.length * COLUMNS) });
  }

  get size() { return this.vehicles.length * COLUMNS; }
  get end() { return this.start + (this.frames - 1) * this.period; }

  async load(station, changed) {
    while (this.loaded < this.frames && !this.closed) {
      const { count, rows } = await station.call('recordings.frames', { file: this.file, first: this.loaded });
      this.rows.set(rowsOf(rows), this.loaded * this.size);
      this.loaded += count;
      changed();
    }
  }

  frame(time, roster) {
    const number = Math.max(0, Math.min(Math.round((time - this.start) / this.period), this.loaded - 1));
    return fleetFrame(this.rows.subarray(number * this.size, (number + 1) * this.size), this.vehicles.length, time, roster, number);
  }
}

const stamp = (seconds) => {
  const minutes = Math.floor(seconds / 60);
  return `${minutes}:${(seconds - 60 * minutes).toFixed(1).padStart(4, '0')}`;
};

function mount(element, station) {
  const state = { files: [], profiles: ['light'], profile: 'light', recorder: { recording: false }, flight: null, time: 0, playing: false, speed: 1,
    words: '', opening: '' };
  let before = 0;

  const fail = (error) => toast(error.message, 'bad');

  /** Says over the view that it shows a recording. */
  const mark = (file) => {
    const stage = document.getElementById('stage-body');
    if (file) stage.dataset.recording = file;
    else delete stage.dataset.recording;
  };

  const list = () => station.call('recordings.list').then(({ files, profiles }) => { Object.assign(state, { files, profiles }); draw(); }, () => {});
  const readState = () => station.call('recordings.state').then((recorder) => {
    const ended = state.recorder.recording && !recorder.recording;
    state.recorder = recorder;
    if (ended) list();
    draw();
  }, () => {});

  const start = () => station.call('recordings.start', { profile: state.profile }).then((recorder) => { state.recorder = recorder; draw(); }, fail);
  const stop = () => station.call('recordings.stop').then(({ name }) => { toast(`recorded runs/${name}`); readState(); list(); }, fail);

  const open = async (file) => {
    close();
    state.opening = file;
    draw();
    try {
      const about = await station.call('recordings.open', { file });
      if (state.opening !== file) return; // another one has been asked for since
      const flight = new Flight(file, about);
      Object.assign(state, { flight, time: flight.start, playing: false });
      station.replay(flight.frame(flight.start, -1));
      station.emit('fleet.roster', { version: -1, vehicles: flight.vehicles.map((name) => ({ name, type: name.replace(/_\d+$/, ''), model: name.replace(/_\d+$/, '') })),
        movers: [], places: {} });
      mark(file);
      flight.load(station, draw).then(() => show(), (error) => { flight.trouble = error.message; draw(); });
    } catch (error) { fail(error); }
    if (state.opening === file) state.opening = '';
    draw();
  };

  const close = () => {
    if (!state.flight) return;
    state.flight.closed = true;
    state.flight = null;
    mark('');
    station.replay(null);
    if (station.connected) station.call('fleet.roster').then((roster) => station.emit('fleet.roster', roster), () => {});
    draw();
  };

  const show = () => { if (state.flight?.loaded) station.replay(state.flight.frame(state.time, -1)); };

  const seek = (time) => {
    state.time = Math.max(state.flight.start, Math.min(time, state.flight.end));
    show();
    draw();
  };

  const tick = (now) => {
    request = requestAnimationFrame(tick);
    const passed = Math.min((now - before) / 1000, 0.25);
    before = now;
    if (!state.flight || !state.playing) return;
    const loaded = state.flight.start + Math.max(0, state.flight.loaded - 1) * state.flight.period;
    state.time = Math.min(state.time + passed * state.speed, loaded);
    if (state.time >= state.flight.end) state.playing = false;
    show();
    draw();
  };

  /** Loads the pictures of a report one after the other. */
  const loadPictures = async (flight) => {
    if (flight.loading || !flight.results) return;
    flight.loading = true;
    for (const file of flight.results.pictures) {
      if (flight.closed) return;
      try { flight.shown.set(file, (await station.call('recordings.picture', { file })).png); } catch (error) { fail(error); }
      draw();
    }
  };

  const report = (flight) => html`<details class="report" data-role="report" ontoggle=${(event) => event.target.open && loadPictures(flight)}>
    <summary>Report of ${flight.results.folder}: ${flight.results.figures.length} figures, ${flight.results.pictures.length} pictures</summary>
    ${flight.results.trouble ? html`<p class="warn">${flight.results.trouble}</p>` : ''}
    <div class="figures"><table><tbody>${flight.results.figures.map(([name, value]) => html`<tr data-figure=${name}><td class="mono text">${name}</td>
      <td class="num">${figure(value)}</td></tr>`)}</tbody></table></div>
    ${[...flight.shown].map(([file, png]) => html`<figure key=${file}><figcaption class="soft">${file.split('/').pop()}</figcaption>
      <img alt=${file} data-picture=${file} src=${`data:image/png;base64,${png}`}/></figure>`)}</details>`;

  const player = ({ flight }) => html`<div class="card" data-role="player"><div class="row"><b class="mono">${flight.file}</b><span class="grow"></span>
      <button onclick=${close}>Back to the flight</button></div>
    ${flight.trouble ? html`<p class="bad">Only the first ${stamp(flight.loaded * flight.period)} are here: ${flight.trouble}. Open it again for the rest.</p>` : ''}
    ${flight.notes.map((note) => html`<p class="warn">${note}</p>`)}
    <div class="row"><button class="primary" data-role="play" onclick=${() => { if (state.time >= flight.end) state.time = flight.start; state.playing = !state.playing; draw(); }}>
        ${state.playing ? '❚❚' : '▶'}</button>
      <button onclick=${() => seek(state.time - 1)}>−1 s</button><button onclick=${() => seek(state.time + 1)}>+1 s</button>
      <select title="speed" onchange=${(event) => { state.speed = Number(event.target.value); }}>
        ${SPEEDS.map((speed) => html`<option value=${speed} selected=${speed === state.speed}>${speed}×</option>`)}</select>
      <span class="mono" data-role="time">${stamp(state.time)} of ${stamp(flight.end)}</span>
      <span class="soft">${flight.loaded < flight.frames ? `loading ${((100 * flight.loaded) / flight.frames).toFixed(0)} %` : `${flight.vehicles.length} vehicles`}</span></div>
    <div class="timeline"><input type="range" data-role="seek" style="width:100%" min=${flight.start} max=${flight.end} step=${flight.period} value=${state.time}
        oninput=${(event) => { state.playing = false; seek(Number(event.target.value)); }}/>
      ${flight.events.filter(({ kind }) => kind === 'mode' || kind === 'armed').slice(0, EVENTS_SHOWN).map((event) => html`<i class=${event.kind}
        style=${`left:${(100 * (event.time - flight.start)) / Math.max(flight.end - flight.start, 1e-9)}%`}
        title=${`${stamp(event.time)} ${event.vehicle} ${event.text}`}></i>`)}</div>
    <details><summary>${flight.events.length} events</summary><table><tbody>${flight.events.slice(0, EVENTS_SHOWN).map((event) => html`<tr
      class="link ${event.time <= state.time ? '' : 'soft'}" onclick=${() => seek(event.time)}><td class="num mono">${stamp(event.time)}</td><td>${event.vehicle}</td>
      <td class=${KINDS[event.kind]}>${event.kind}</td><td class="text">${event.text}</td></tr>`)}</tbody></table></details>
    ${flight.results ? report(flight) : ''}</div>`;

  const recorder = () => (state.recorder.recording
    ? html`<span class="pill bad">● recording</span><span class="mono">${state.recorder.name}</span>
      <span class="soft">${stamp(state.recorder.seconds)}, ${bytes(state.recorder.bytes)}</span><button class="danger" data-role="stop" onclick=${stop}>Stop</button>`
    : html`<select title="recording profile" onchange=${(event) => { state.profile = event.target.value; }}>
      ${state.profiles.map((profile) => html`<option value=${profile} selected=${profile === state.profile}>${profile}</option>`)}</select>
      <button class="primary" data-role="record" onclick=${start}>● Record</button>`);

  function draw() {
    const words = state.words.toLowerCase();
    const files = state.files.filter(({ file }) => file.toLowerCase().includes(words));
    render(html`<div class="row operate">${recorder()}</div>
      ${state.flight ? player(state) : ''}
      <div class="row"><input type="search" placeholder="filter recordings of runs/" style="flex:1" value=${state.words}
        oninput=${(event) => { state.words = event.target.value; draw(); }}/><button onclick=${list}>Refresh</button></div>
      <table><thead><tr><th>recording</th><th></th><th class="num">size</th><th>changed</th></tr></thead><tbody>
      ${files.map(({ file, bytes: size, changed, report: analysed }) => html`<tr key=${file} data-file=${file} class=${state.flight?.file === file ? 'selected' : ''}>
        <td class="text link mono" onclick=${() => open(file)}>${file}${state.opening === file ? ' opening…' : ''}</td><td>${analysed ? html`<span class="pill" title="with a report">report</span>` : ''}</td><td class="num">${bytes(size)}</td>
        <td class="soft">${new Date(1000 * changed).toLocaleString()}</td></tr>`)}</tbody></table>
      ${files.length ? '' : html`<p class="soft">No recordings yet.</p>`}`, element);
  }

  let request = requestAnimationFrame(tick);
  const offs = [station.onConnect(() => { list(); readState(); })];
  const timers = [setInterval(readState, STATE_PERIOD), setInterval(list, LIST_PERIOD)];
  draw();
  return () => {
    cancelAnimationFrame(request);
    timers.forEach(clearInterval);
    offs.forEach((off) => off());
    close();
    render(null, element);
  };
}

export const panel = { name: 'recordings', title: 'Recordings', icon: '●', mount };
