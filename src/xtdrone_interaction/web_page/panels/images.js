// Images of camera topics, with the boxes of detectors.
import { html, render } from '../vendor/preact_htm.js';
import { toast } from '../station.js';
import { NO_PUBLISHER, Subscription, matching } from '../topic_choice.js';

const CHANNEL = 2;
const HEADER = 24; // bytes, as xtdrone_interaction/web/images/image_room.py packs them
const LIST_PERIOD = 5000; // ms
const OFFERED = 40;
const STORED = 'xtdrone-images';

/** Reads a frame: number of the subscription, time (s), size of the original image (px), JPEG. */
export function readImageFrame(buffer) {
  const view = new DataView(buffer);
  if (view.getUint8(1) !== 1) throw new Error(`image frame: version ${view.getUint8(1)} is not allowed, 1`);
  return {
    subscription: view.getUint32(4, true),
    time: view.getFloat64(8, true),
    width: view.getUint16(16, true),
    height: view.getUint16(18, true),
    jpeg: new Uint8Array(buffer, HEADER),
  };
}

/** One shown topic. */
class View {
  canvas = document.createElement('canvas');
  frame = null;
  boxes = [];
  fault = '';
  gone = false; // no node publishes the topic
  times = [];
  detections = null;
  constructor(station, topic, detections, changed) {
    Object.assign(this, { station, topic, changed });
    this.subscription = new Subscription(station, 'images.open', { topic, rate: 10, width: 960 }, 'images.close', (error) => {
      this.fault = error.message;
      changed();
    }, () => { this.fault = ''; this.times = []; changed(); });
    this.setDetections(detections);
  }

  setDetections(topic) {
    this.detections?.close();
    this.detectionTopic = topic ?? '';
    this.boxes = [];
    this.detections = topic ? new Subscription(this.station, 'topics.echo', { topic, rate: 20, longest: 300 }, 'topics.close',
      (error) => toast(error.message, 'bad')) : null;
  }

  async show(frame) {
    const picture = await createImageBitmap(new Blob([frame.jpeg], { type: 'image/jpeg' }));
    this.frame = frame;
    this.fault = '';
    this.times = [...this.times, performance.now()].slice(-20);
    const { canvas } = this;
    [canvas.width, canvas.height] = [picture.width, picture.height];
    const pen = canvas.getContext('2d');
    pen.drawImage(picture, 0, 0);
    picture.close();
    this.drawBoxes(pen, canvas.width / frame.width);
    this.changed();
  }

  drawBoxes(pen, scale) {
    pen.lineWidth = 2;
    pen.font = `${Math.max(12, canvas_text(this.canvas))}px system-ui, sans-serif`;
    for (const box of this.boxes) {
      const [x, y] = [box.xmin * scale, box.ymin * scale];
      const label = `${box.Class} ${(100 * Number(box.probability)).toFixed(0)} %`;
      pen.strokeStyle = '#ffce3a';
      pen.strokeRect(x, y, (box.xmax - box.xmin) * scale, (box.ymax - box.ymin) * scale);
      pen.fillStyle = '#000b';
      pen.fillRect(x, y - 18, pen.measureText(label).width + 8, 18);
      pen.fillStyle = '#ffce3a';
      pen.fillText(label, x + 4, y - 4);
    }
  }

  get rate() {
    const { times } = this;
    return times.length > 1 ? (1000 * (times.length - 1)) / (times.at(-1) - times[0]) : 0;
  }

  close() { this.subscription.close(); this.detections?.close(); }
}

const canvas_text = (canvas) => Math.round(canvas.height / 32);

function mount(element, station) {
  const state = { images: [], detections: [], words: '' };
  let views = [];
  const bar = document.createElement('div');
  const pictures = document.createElement('div');
  pictures.className = 'pictures';
  element.append(bar, pictures);

  /** Returns the boxes' topic that belongs to an image: the only one of its vehicle. */
  const boxesOf = (topic) => {
    const vehicle = topic.split('/')[1];
    const own = state.detections.filter((name) => name.split('/').includes(vehicle));
    return own.length === 1 ? own[0] : null;
  };

  const remember = () => { try { localStorage.setItem(STORED, JSON.stringify(views.map(({ topic }) => topic))); } catch { /* none in a private window */ } };

  const add = (topic) => {
    if (!topic || views.some((view) => view.topic === topic)) return;
    const view = new View(station, topic, boxesOf(topic), () => label(view));
    view.card = document.createElement('div');
    view.card.className = 'card';
    view.card.dataset.image = topic;
    view.head = document.createElement('div');
    view.card.append(view.head, view.canvas);
    pictures.append(view.card);
    views.push(view);
    remember();
    label(view);
    draw();
  };

  const remove = (view) => {
    view.close();
    view.card.remove();
    views = views.filter((other) => other !== view);
    remember();
    draw();
  };

  const label = (view) => render(html`<div class="row"><b class="mono">${view.topic}</b><span class="grow"></span>
    ${state.detections.length ? html`<select title="detections" onchange=${(event) => view.setDetections(event.target.value || null)}>
      <option value="">no detections</option>${state.detections.map((name) => html`<option value=${name} selected=${name === view.detectionTopic}>${name}</option>`)}</select>` : ''}
    <button class="small" onclick=${() => view.canvas.requestFullscreen?.()}>Full</button><button class="small" onclick=${() => remove(view)}>✕</button></div>
    ${view.gone ? html`<p class="warn" data-role="gone">${NO_PUBLISHER}</p>` : view.fault ? html`<p class="bad">${view.fault}</p>` : html`<p class="soft">${view.frame
      ? `${view.frame.width}×${view.frame.height} px, ${view.frame.time.toFixed(2)} s, ${view.rate.toFixed(1)} Hz, ${view.boxes.length} detections`
      : 'no image yet'}</p>`}`, view.head);

  function draw() {
    const offered = matching(state.images.filter(({ name }) => !views.some(({ topic }) => topic === name)), state.words);
    render(html`<div class="row"><select data-role="image" onchange=${(event) => { add(event.target.value); event.target.value = ''; }} style="flex:1">
        <option value="">${state.images.length ? 'show a camera…' : 'no image topics; cameras:=true starts the cameras'}</option>
        ${offered.slice(0, OFFERED).map(({ name }) => html`<option value=${name}>${name}</option>`)}</select>
      <input type="search" placeholder="filter" value=${state.words} oninput=${(event) => { state.words = event.target.value; draw(); }}/></div>`, bar);
  }

  const list = () => station.call('images.list').then((found) => {
    Object.assign(state, found);
    for (const view of views) {
      if (!view.detectionTopic && boxesOf(view.topic)) view.setDetections(boxesOf(view.topic));
      view.gone = !state.images.some(({ name }) => name === view.topic);
      if (!view.gone) view.subscription.retry();
      label(view);
    }
    draw();
  }, () => {});
  const offs = [
    station.onConnect(list),
    station.onBinary(CHANNEL, (buffer) => {
      const frame = readImageFrame(buffer);
      views.find((view) => view.subscription.number === frame.subscription)?.show(frame)
        .catch((error) => console.error('image', error));
    }),
    station.on('images.fault', ({ subscription, text }) => {
      const view = views.find((other) => other.subscription.number === subscription);
      if (view) { view.fault = text; label(view); }
    }),
    station.on('topics.message', ({ subscription, message }) => {
      const view = views.find((other) => other.detections?.number === subscription);
      if (view && message?.bounding_boxes) view.boxes = message.bounding_boxes.first ?? message.bounding_boxes;
    }),
  ];
  const timer = setInterval(list, LIST_PERIOD);
  let stored = [];
  try { stored = JSON.parse(localStorage.getItem(STORED)) ?? []; } catch { /* another version's */ }
  stored.forEach(add);
  draw();
  return () => {
    clearInterval(timer);
    offs.forEach((off) => off());
    views.forEach((view) => view.close());
    element.replaceChildren();
  };
}

export const panel = { name: 'images', title: 'Images', icon: '▣', mount };
