// Choosing a topic and a field: shared by the panels that subscribe.

/** Keeps a subscription of the server over reconnections. */
export class Subscription {
  #off;
  #open;
  number = null;
  refused = false; // the last attempt to open it

  /**
   * @param {import('./station.js').Station} station
   * @param {string} method that opens it and answers {subscription}
   * @param {object} params
   * @param {string} closing method that ends it
   * @param {(error: Error) => void} onError called if it is refused
   * @param {(number: number) => void} onOpen called with its number, after each connection
   */
  constructor(station, method, params, closing, onError, onOpen = () => {}) {
    this.station = station;
    this.closing = closing;
    this.closed = false;
    this.#open = () => {
      this.refused = false;
      this.number = null; // that of the connection before may be another topic's in this one
      station.call(method, params).then(({ subscription }) => {
        this.number = subscription;
        if (this.closed) this.#end(); else onOpen(subscription);
      }, (error) => {
        this.refused = true;
        if (!this.closed) onError(error);
      });
    };
    this.#off = station.onConnect(this.#open);
  }

  /** Opens it again if it was refused, as that of a topic that was not there. */
  retry() {
    if (this.refused && !this.closed && this.station.connected) this.#open();
  }

  close() {
    this.closed = true;
    this.#off();
    if (this.number !== null) this.#end();
  }

  #end() {
    this.station.call(this.closing, { subscription: this.number }).catch(() => {}); // a broken connection has ended it
  }
}

export const NO_PUBLISHER = 'No node publishes this topic now.';

/** Returns the topics whose names or types contain all words. */
export function matching(topics, words) {
  const wanted = words.toLowerCase().split(/\s+/).filter(Boolean);
  return topics.filter(({ name, type }) => wanted.every((word) => `${name} ${type}`.toLowerCase().includes(word)));
}

/** Rates with as many digits as can be read. */
export const rate = (value) => (value === undefined ? '' : value >= 100 ? value.toFixed(0) : value.toFixed(1));

/** Bytes per s or bytes in readable units. */
export function bytes(value) {
  if (value === undefined) return '';
  for (const [unit, size] of [['MB', 1e6], ['kB', 1e3]]) if (value >= size) return `${(value / size).toFixed(1)} ${unit}`;
  return `${value.toFixed(0)} B`;
}

/** Saves text as a file of the user's. */
export function save(name, text, type = 'text/csv') {
  const link = document.createElement('a');
  link.href = URL.createObjectURL(new Blob([text], { type }));
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}
