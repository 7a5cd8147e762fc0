// Simulated time in the bar: state, pause, step, speed, reset, real-time factor, and who holds the tick.
import { html, render } from '../vendor/preact_htm.js';
import { confirmed, toast } from '../station.js';

const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 5, 10, 0]; // 0: as fast as it goes
const HELD = 0.5; // s of wall time after which a participant is named
const TICKS = [1, 10, 100];

const clock = (time) => `${String(Math.floor(time / 60)).padStart(2, '0')}:${(time % 60).toFixed(1).padStart(4, '0')}`;
const factor = (speed) => (speed ? `${speed}×` : 'max');

/** Says in a few words whether time goes on, and if not, why. */
export function stateOf(status) {
  if (!status) return ['', 'no simulator'];
  if (status.stepping) return ['warn', 'stepping'];
  if (status.paused) return ['warn', 'paused'];
  if (status.waiting_for.length && status.waiting >= HELD) return ['bad', `held by ${status.waiting_for.join(', ')}`];
  if (status.reason) return ['bad', status.reason];
  return ['good', 'running'];
}

function mount(element, station) {
  let status = null;
  let ticks = TICKS[0];
  const call = (method, params) => station.call(method, params).then((text) => toast(text), (error) => toast(error.message, 'bad'));
  const control = (params) => call('time.control', params);
  const reset = async () => {
    if (await confirmed('Set all vehicles back to their start places, and time to 0?', 'Reset')) call('time.reset');
  };
  const show = () => {
    const [kind, text] = station.connected && !station.silent ? stateOf(status) : ['warn', 'not known'];
    const held = status?.waiting_for.length ? `waiting for ${status.waiting_for.join(', ')} since ${status.waiting.toFixed(1)} s` : '';
    render(html`<div class="row" style="margin:0">
      <b class="mono" data-cell="clock" title="simulated time">${status ? clock(station.fleet?.time > status.time && !status.paused ? station.fleet.time : status.time) : '–'}</b>
      <span class=${`pill ${kind}`} data-cell="time-state" title=${held || (status ? `participants: ${status.participants.join(', ')}` : '')}>${text}</span>
      <span class="soft" title="real-time factor over the last second" data-cell="factor">${status ? `${status.measured.toFixed(2)}× real time` : ''}</span>
      <span class="operate row" style="margin:0">
        <span class="group"><button data-time="pause" title=${status?.paused ? 'let time run' : 'stop time'} onclick=${() => control({ action: status?.paused ? 'resume' : 'pause' })}>
          ${status?.paused ? 'Resume' : 'Pause'}</button>
        <button data-time="step" title="advance by this many ticks, then pause" onclick=${() => control({ action: 'step', ticks })}>Step</button></span>
        <select class="wide-only" title="ticks of a step" value=${ticks} onchange=${(event) => { ticks = Number(event.target.value); }}>
          ${TICKS.map((count) => html`<option value=${count}>${count}</option>`)}</select>
        <label class="wide-only row" style="margin:0">speed <input data-time="speed" type="range" min="0" max=${SPEEDS.length - 1} step="1" style="width:110px"
          value=${Math.max(0, SPEEDS.indexOf(status?.speed ?? 1))} onchange=${(event) => control({ action: 'speed', factor: SPEEDS[event.target.valueAsNumber] })}/>
          <span data-cell="speed">${status ? factor(status.speed) : ''}</span></label>
        <button class="wide-only" data-time="reset" onclick=${reset}>Reset…</button></span></div>`, element);
  };
  const accept = (news) => { status = news; show(); };
  const offs = [
    station.on('time.status', accept),
    station.onConnect(() => station.call('time.status').then(accept, () => {})),
    station.on('station.state', show),
  ];
  const timer = setInterval(show, 500);
  show();
  return () => { offs.forEach((off) => off()); clearInterval(timer); };
}

export const panel = { name: 'time', title: 'Time', place: 'bar', mount };
