// Keyboard and gamepad, with the keys, steps and limits of multirotor_keyboard_control.
import { html, render } from '../vendor/preact_htm.js';
import { toast } from '../station.js';

const PERIOD = 100; // ms between two words to the station
const REPEAT = 80; // ms between two steps of a held button
const DEAD = 0.12; // of a stick's way
const LATE = 60000; // ms without the station after which others may fly what this page flew
const AXES = ['forward', 'left', 'up', 'turn'];
const UNITS = ['m/s', 'm/s', 'm/s', 'rad/s'];
const PAD = [['w', 'forward'], ['x', 'back'], ['a', 'left'], ['d', 'right'], ['i', 'up'], [',', 'down'], ['j', 'turn left'], ['l', 'turn right']];
const COMMANDS = [['t', 'Arm'], ['v', 'Take off'], ['b', 'Offboard'], ['s', 'Hover'], ['n', 'Land'], ['r', 'Return'], ['y', 'Disarm']];
const KEYS = new Set([...PAD, ...COMMANDS].map(([key]) => key).concat(['k', 'g', ...'0123456789']));

/** Returns a stick's way beyond its dead middle, finer near the middle. */
export function shaped(value) {
  const beyond = Math.max(0, Math.abs(value) - DEAD) / (1 - DEAD);
  return Math.sign(value) * (0.3 * beyond + 0.7 * beyond ** 3);
}

/** Returns forward, left, up and turn of a gamepad in mode 2: left stick up and turn, right stick forward and left. */
export function sticks(pad, most) {
  const [turn, up, left, forward] = [0, 1, 2, 3].map((i) => -shaped(pad.axes[i] ?? 0));
  return [forward * most.speed, left * most.speed, up * most.speed, turn * most.turn].map((value) => Math.round(100 * value) / 100);
}

function mount(element, station) {
  const state = { open: false, pilot: null, leader: false, mode: 'vel', speed: 2, turn: 1, pad: '', vehicles: [] };
  let moved = false; // the sticks steer until they are back in the middle
  let buttons = [];
  let lost = null; // what this page flew when the connection broke

  const fail = (error) => { toast(error.message, 'bad'); };
  const told = (pilot) => { state.pilot = pilot; state.leader = pilot.leader; draw(); };

  const names = () => (station.selection.size ? station.selection.names : station.roster.vehicles.map(({ name }) => name));

  const begin = async () => {
    state.vehicles = names();
    try {
      told(await station.call('steering.open', { vehicles: state.vehicles, leader: state.leader, mode: state.mode }));
      state.open = true;
      document.activeElement?.blur?.();
    } catch (error) { fail(error); }
    draw();
  };

  const end = () => {
    state.open = false;
    state.pilot = null;
    station.call('steering.close').catch(() => {}); // a broken connection has ended it
    draw();
  };

  const press = (key) => { if (state.open) station.call('steering.key', { key }).then(told, fail); };

  const onKey = (event) => {
    if (!state.open || event.ctrlKey || event.altKey || event.metaKey || /^(INPUT|SELECT|TEXTAREA)$/.test(event.target.tagName)) return;
    const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    if (key === 'Escape') end();
    else if (KEYS.has(key)) { event.preventDefault(); press(key); }
  };

  const readPad = () => {
    const pad = [...(navigator.getGamepads?.() ?? [])].find((other) => other?.connected);
    const id = pad?.id ?? '';
    if (id !== state.pad) { state.pad = id; draw(); }
    if (!state.open) return;
    if (!pad && moved) {
      moved = false;
      toast('The gamepad has disappeared: the vehicles stop.', 'bad');
      station.call('steering.sticks', { speeds: [0, 0, 0, 0] }).then(told, fail);
      return;
    }
    if (pad) {
      const keys = ['n', 'y', 's', 'v', null, null, null, null, 't', 'b']; // A, B, X, Y, ..., back, start
      pad.buttons.forEach(({ pressed }, i) => { if (pressed && !buttons[i] && keys[i]) press(keys[i]); });
      buttons = pad.buttons.map(({ pressed }) => pressed);
      const speeds = sticks(pad, { speed: state.speed, turn: state.turn });
      const moving = speeds.some((value) => value !== 0);
      if (moving || moved) {
        moved = moving;
        station.call('steering.sticks', { speeds }).then(told, fail);
        return;
      }
    }
    station.call('steering.alive').then((pilot) => { if (pilot.note !== state.pilot?.note || String(pilot.speeds) !== String(state.pilot?.speeds)) told(pilot); },
      () => { state.open = false; state.pilot = null; draw(); });
  };

  /** A held button steps again and again, as a held key does. */
  const held = (key) => ({
    onpointerdown: (event) => {
      event.preventDefault();
      press(key);
      const timer = setInterval(() => press(key), REPEAT);
      const stop = () => { clearInterval(timer); removeEventListener('pointerup', stop); removeEventListener('pointercancel', stop); };
      addEventListener('pointerup', stop);
      addEventListener('pointercancel', stop);
    },
  });

  const bars = ({ speeds }) => html`<table class="steering"><tbody>${AXES.map((axis, i) => html`<tr><td>${axis}</td>
    <td style="width:50%"><meter min=${i === 3 ? -3 : -20} max=${i === 3 ? 3 : 20} value=${speeds[i]} style="width:100%"></meter></td>
    <td class="num mono" data-axis=${axis}>${speeds[i].toFixed(2)} ${UNITS[i]}</td></tr>`)}</tbody></table>`;

  /** Says which steered vehicles ignore the speeds, and the key that changes it. */
  const deaf = () => {
    if (state.pilot.leader) return ''; // vehicles that follow it are in OFFBOARD by their own nodes
    const modes = state.vehicles.map((name) => [name, station.status.vehicles[name]?.mode]);
    const others = modes.filter(([, mode]) => mode && mode !== 'OFFBOARD');
    if (!others.length) return '';
    const [name, mode] = others[0];
    const whose = others.length === 1 ? `${name} is in ${mode} and ignores` : `${name} (${mode}) and ${others.length - 1} more ignore`;
    return html`<p class="warn" data-role="deaf">${whose} speeds until OFFBOARD: key b.</p>`;
  };

  const flying = () => html`<div class="card"><div class="row"><b>${state.pilot.leader ? 'the leader' : state.vehicles.join(', ')}</b><span class="grow"></span>
      <button data-role="target" onclick=${() => press('g')}>g: ${state.pilot.leader ? 'vehicles' : 'leader'}</button>
      <button class="danger" data-role="end" onclick=${end}>End (Esc)</button></div>
    <p class=${state.pilot.note ? '' : 'soft'} data-role="note">${state.pilot.note || 'Keys work while this panel is open. Each press is 0.01 m/s; hold it.'}</p>
    ${deaf()}${bars(state.pilot)}
    <div class="keys">${PAD.map(([key, text]) => html`<button data-key=${key} ...${held(key)}><b class="mono">${key}</b> ${text}</button>`)}</div>
    <div class="row">${COMMANDS.map(([key, text]) => html`<button data-key=${key} onclick=${() => press(key)}><b class="mono">${key}</b> ${text}</button>`)}</div>
    ${state.pilot.leader ? html`<div class="row">${Object.entries(state.pilot.patterns).map(([digit, name]) => html`<button onclick=${() => press(digit)}>
      <b class="mono">${digit}</b> ${name}</button>`)}<button onclick=${() => press('0')}><b class="mono">0</b> waiting</button></div>` : ''}</div>`;

  const ready = () => html`<div class="card operate"><p>The keys fly ${station.selection.size ? station.selection.names.join(', ') : 'all vehicles'} on
      the topics of multirotor_keyboard_control. The vehicles stop when this panel or the page is closed, or the page is silent for a second.</p>
    <div class="row"><label><input type="checkbox" checked=${state.leader} onchange=${() => { state.leader = !state.leader; draw(); }}/> the leader first</label>
      <select title="quantity set by the keys" onchange=${(event) => { state.mode = event.target.value; }}><option value="vel">velocities</option>
        <option value="accel">accelerations</option></select>
      <button class="primary" data-role="begin" onclick=${begin}>Begin</button></div></div>`;

  function draw() {
    render(html`${station.role === 'operate' ? (state.open && state.pilot ? flying() : ready()) : html`<p class="soft">This page has watch-only access.</p>`}
      <div class="card"><b>Gamepad</b> <span class=${state.pad ? 'good' : 'soft'}>${state.pad || 'none: press a button on it'}</span>
        <p class="soft">Left stick: up and turn; right stick: forward and left. A land, B disarm, X hover, Y take off, back arm, start offboard.</p>
        <div class="row"><label>maximum m/s <input type="number" min="0.5" max="20" step="0.5" value=${state.speed}
            onchange=${(event) => { state.speed = Math.min(20, Math.max(0.5, Number(event.target.value) || 2)); draw(); }}/></label>
          <label>maximum rad/s <input type="number" min="0.1" max="3" step="0.1" value=${state.turn}
            onchange=${(event) => { state.turn = Math.min(3, Math.max(0.1, Number(event.target.value) || 1)); draw(); }}/></label></div></div>`, element);
  }

  /** Stops what this page flew by a station that was killed and could not stop it. */
  const stopLost = () => {
    const params = lost;
    lost = null;
    if (!params || !station.restarted || performance.now() - params.at > LATE) return;
    station.call('steering.stop', params).then(({ stopped }) => {
      if (stopped.length) toast(`The station was started again; stopped: ${stopped.join(', ')}.`);
    }, fail);
  };

  addEventListener('keydown', onKey);
  const timer = setInterval(readPad, PERIOD);
  const offs = [
    station.selection.onChange(() => { if (!state.open) draw(); }),
    station.onConnect(stopLost),
    station.on('fleet.status', () => { if (state.open) draw(); }),
    station.on('steering.ended', ({ text }) => { state.open = false; state.pilot = null; toast(text, 'bad'); draw(); }),
    station.on('station.state', ({ connected }) => {
      if (!connected && state.open) {
        toast('The connection is lost, and this page no longer steers. The station stops the vehicles; if it was killed, they stop when it is back.', 'bad');
        lost = { vehicles: state.vehicles, leader: state.pilot.leader, mode: state.mode, at: performance.now() };
      }
      if (!connected) { state.open = false; state.pilot = null; }
      draw();
    }),
  ];
  draw();
  return () => {
    if (state.open) end();
    removeEventListener('keydown', onKey);
    clearInterval(timer);
    offs.forEach((off) => off());
    render(null, element);
  };
}

export const panel = { name: 'steering', title: 'Keyboard', icon: '⌨', mount };
