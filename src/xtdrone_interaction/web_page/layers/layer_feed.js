// Layers of a panel by topic: what the station sends of them, over reconnections.
import { Subscription } from '../topic_choice.js';
import { LAYER, readLayerFrame } from './layer_frame.js';

const MOST_EARLY = 64;

export class LayerFeed {
  #station;
  #take;
  #tell;
  #layers = new Map(); // topic -> its subscription
  #topics = new Map(); // number of a subscription -> topic
  #early = new Map(); // number -> frame or fault that came before the number was known, as latched messages do
  #offs;

  /**
   * @param station the page's connection
   * @param take called with a topic and each frame of it
   * @param tell called with a topic and what is wrong with it; '' when that has ended
   */
  constructor(station, take, tell = () => {}) {
    this.#station = station;
    this.#take = take;
    this.#tell = tell;
    this.#offs = [
      station.onBinary(LAYER, (buffer) => {
        const frame = readLayerFrame(buffer);
        this.#pass(frame.subscription, frame);
      }),
      station.on('layers.fault', ({ subscription, text }) => this.#pass(subscription, text)),
      station.on('station.state', () => { this.#topics.clear(); this.#early.clear(); }),
    ];
  }

  get topics() { return [...this.#layers.keys()]; }

  has(topic) { return this.#layers.has(topic); }

  /** Subscribes to a topic at a rate, Hz; one of a known type need not be published yet. */
  open(topic, rate, type) {
    if (this.#layers.has(topic)) return;
    this.#layers.set(topic, new Subscription(this.#station, 'layers.open', { topic, rate, type }, 'layers.close',
      (error) => this.#tell(topic, error.message), (number) => this.#opened(topic, number)));
  }

  close(topic) {
    this.#layers.get(topic)?.close();
    this.#layers.delete(topic);
    for (const [number, name] of this.#topics) if (name === topic) this.#topics.delete(number);
  }

  end() {
    this.topics.forEach((topic) => this.close(topic));
    this.#offs.forEach((off) => off());
  }

  #opened(topic, number) {
    this.#topics.set(number, topic);
    const early = this.#early.get(number);
    this.#early.delete(number);
    if (early !== undefined) this.#pass(number, early);
  }

  #pass(number, content) {
    const topic = this.#topics.get(number);
    if (topic === undefined) {
      if (this.#early.size >= MOST_EARLY) this.#early.delete(this.#early.keys().next().value);
      this.#early.set(number, content);
    } else if (typeof content === 'string') this.#tell(topic, content);
    else { this.#tell(topic, ''); this.#take(topic, content); }
  }
}
