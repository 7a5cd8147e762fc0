// The page's connection to the station: calls, events and binary frames, and what all panels share.
import { readFleetFrame } from './fleet_frame.js';

const FLEET = 1; // channel of the fleet's frames
const FIRST_WAIT = 300; // ms between two attempts to connect; doubled up to the last
const LAST_WAIT = 4000;
const WRONG_TOKEN = 4401; // closing code of the station; any other one, as 4408 for a late hello, may not come again
const ANSWER_LIMIT = 60000; // ms
const MOST_CALLS = 24; // unanswered ones; the station refuses more than 32
const ASK_PERIOD = 1000; // ms between two calls that a living station answers at once
const SILENCE = 4000; // ms without any message after which the page says that the station does not answer
const LOST = 20000; // ms without any message after which the page connects again, as after a lost network

/** Functions by name, which a panel adds and removes. */
class Listeners {
  #sets = new Map();
  add(name, f) {
    if (!this.#sets.has(name)) this.#sets.set(name, new Set());
    this.#sets.get(name).add(f);
    return () => this.#sets.get(name).delete(f);
  }
  call(name, ...values) {
    for (const f of [...(this.#sets.get(name) ?? [])]) {
      try { f(...values); } catch (error) { console.error(name, error); }
    }
  }
}

/** The selected vehicles: a set of names. */
class Selection {
  #names = new Set();
  #listeners = new Listeners();
  get names() { return [...this.#names]; }
  get size() { return this.#names.size; }
  has(name) { return this.#names.has(name); }
  set(names) { this.#names = new Set(names); this.#listeners.call('change'); }
  toggle(name) {
    if (!this.#names.delete(name)) this.#names.add(name);
    this.#listeners.call('change');
  }
  onChange(f) { return this.#listeners.add('change', f); }
}

export class Station {
  role = 'view';
  connected = false;
  silent = false; // connected, but no message comes
  restarted = false; // another start of the station than at the connection before
  replaying = false; // a recording is shown
  fleet = null; // the last frame
  roster = { version: -1, vehicles: [], movers: [], places: {} };
  status = { vehicles: {} }; // the last fleet.status, its vehicles by name
  selection = new Selection();
  #events = new Listeners();
  #binary = new Listeners();
  #socket = null;
  #calls = new Map();
  #waiting = []; // calls that are sent when others have been answered
  #next = 1;
  #wait = FIRST_WAIT;
  #heard = performance.now(); // when the last message came
  #asked = false; // whether the station has been asked something to hear from it
  #instance = null; // number of this start of the station
  #token = new URLSearchParams(location.hash.slice(1)).get('token') ?? '';

  constructor() {
    this.on('fleet.roster', (roster) => { this.roster = roster; });
    this.on('fleet.status', (status) => { this.status = status; });
    setInterval(() => this.#watch(), ASK_PERIOD);
  }

  /** Connects, and again whenever the connection breaks. */
  start() {
    const url = new URL('ws', location.href);
    url.protocol = location.protocol === 'https:' ? 'wss:' : 'ws:';
    url.hash = '';
    const socket = this.#socket = new WebSocket(url);
    this.#heard = performance.now();
    socket.binaryType = 'arraybuffer';
    socket.onopen = () => {
      this.#request('hello', { token: this.#token }).then((welcome) => this.#greeted(welcome)).catch(() => socket.close());
    };
    socket.onmessage = ({ data }) => this.#received(data);
    socket.onclose = (event) => this.#closed(event);
  }

  /** Calls a method of the server; the promise is rejected with the server's reason. */
  call(method, params = {}) {
    if (!this.connected) return Promise.reject(new Error('the station is not connected'));
    return this.#request(method, params);
  }

  /** Calls f with the data of each event of a name; returns a function that ends that. */
  on(event, f) { return this.#events.add(event, f); }

  /** Calls f with each binary frame (an ArrayBuffer with its first byte) of a channel. */
  onBinary(channel, f) { return this.#binary.add(channel, f); }

  /** Calls f now, if connected, and after each connection: for subscriptions, which end with a connection. */
  onConnect(f) {
    if (this.connected) f();
    return this.#events.add('station.connect', f);
  }

  /** Shows a recorded frame of the fleet in place of the flight's; null: the flight's again. */
  replay(buffer) {
    this.replaying = buffer !== null;
    if (buffer === null) return;
    this.fleet = readFleetFrame(buffer);
    this.#binary.call(FLEET, buffer);
  }

  /** Tells panels of this page something, as if the server had. */
  emit(event, data) { this.#events.call(event, data); }

  #request(method, params) {
    return new Promise((resolve, reject) => {
      const call = { id: this.#next++, method, params, resolve, reject };
      if (this.#calls.size < MOST_CALLS) this.#send(call);
      else this.#waiting.push(call);
    });
  }

  #send({ id, method, params, resolve, reject }) {
    const limit = setTimeout(() => this.#settle(id, { error: `${method}: no answer within 60 s` }), ANSWER_LIMIT);
    this.#calls.set(id, { resolve, reject, limit });
    this.#socket.send(JSON.stringify({ id, method, params }));
  }

  #settle(id, answer) {
    const call = this.#calls.get(id);
    if (!call) return;
    this.#calls.delete(id);
    clearTimeout(call.limit);
    if ('error' in answer) call.reject(new Error(answer.error));
    else call.resolve(answer.result);
    if (this.#waiting.length && this.connected) this.#send(this.#waiting.shift());
  }

  /** Notices a station that no longer answers, whose connection may stay open for minutes. */
  #watch() {
    const silence = performance.now() - this.#heard;
    if (silence > LOST) this.#abandon();
    else if (this.connected) {
      this.#ask();
      this.#setSilent(silence > SILENCE);
    }
  }

  /** Asks something that a living station answers at once, ahead of the calls that wait. */
  #ask() {
    if (this.#asked) return;
    this.#asked = true;
    const answered = () => { this.#asked = false; };
    this.#send({ id: this.#next++, method: 'time.status', params: {}, resolve: answered, reject: answered });
  }

  #setSilent(silent) {
    if (silent === this.silent) return;
    this.silent = silent;
    this.#tellState();
  }

  #tellState() { this.emit('station.state', { connected: this.connected, silent: this.silent, role: this.role }); }

  /** Gives up a connection, without waiting for the other side to close it. */
  #abandon() {
    const socket = this.#socket;
    if (!socket || socket.readyState === WebSocket.CLOSED) return;
    socket.onopen = socket.onmessage = socket.onclose = null;
    socket.close();
    this.#heard = performance.now();
    this.#closed({});
  }

  #received(data) {
    this.#heard = performance.now();
    this.#setSilent(false);
    if (typeof data !== 'string') {
      const channel = new Uint8Array(data, 0, 1)[0];
      if (channel === FLEET && this.replaying) return;
      if (channel === FLEET) this.fleet = readFleetFrame(data);
      this.#binary.call(channel, data);
      return;
    }
    const message = JSON.parse(data);
    if (this.replaying && message.event === 'fleet.roster') return; // of the flight; asked for when it is shown again
    if ('event' in message) this.#events.call(message.event, message.data);
    else this.#settle(message.id, message);
  }

  async #greeted(welcome) {
    this.role = welcome.role;
    this.restarted = this.#instance !== null && this.#instance !== welcome.station;
    this.#instance = welcome.station;
    this.connected = true;
    this.#wait = FIRST_WAIT;
    const roster = await this.call('fleet.roster');
    if (!this.replaying) this.emit('fleet.roster', roster);
    this.#tellState();
    this.emit('station.connect');
  }

  #closed({ code }) {
    this.connected = this.silent = false;
    for (const id of [...this.#calls.keys()]) this.#settle(id, { error: 'the connection broke' });
    this.#waiting.splice(0).forEach(({ reject }) => reject(new Error('the connection broke')));
    const refused = code === WRONG_TOKEN;
    this.emit('station.state', { connected: false, refused });
    if (refused) return; // another token needs another URL
    setTimeout(() => this.start(), this.#wait);
    this.#wait = Math.min(2 * this.#wait, LAST_WAIT);
  }
}

// ---- what panels say to the user

/** Shows a line for some seconds. */
export function toast(text, kind = '') {
  const element = document.createElement('div');
  element.className = `toast ${kind}`;
  element.textContent = text;
  element.onclick = () => element.remove();
  document.getElementById('toasts').append(element);
  setTimeout(() => element.remove(), kind === 'bad' ? 12000 : 4000);
}

/** Asks before something that cannot be taken back; resolves to whether the user is sure. */
export function confirmed(question, action) {
  const dialog = document.getElementById('question');
  dialog.replaceChildren();
  const text = document.createElement('p');
  text.textContent = question;
  const row = document.createElement('div');
  row.className = 'row';
  const yes = document.createElement('button');
  yes.className = 'danger sure';
  yes.textContent = action;
  const no = document.createElement('button');
  no.textContent = 'Cancel';
  row.append(yes, no);
  dialog.append(text, row);
  return new Promise((resolve) => {
    yes.onclick = () => dialog.close('yes');
    no.onclick = () => dialog.close('no');
    dialog.onclose = () => resolve(dialog.returnValue === 'yes');
    dialog.returnValue = 'no';
    dialog.showModal();
    no.focus();
  });
}
