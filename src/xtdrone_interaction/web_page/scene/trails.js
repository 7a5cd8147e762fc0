// Trails of the vehicles, as line segments in a ring: each step writes one segment of each vehicle.
import { BufferAttribute, BufferGeometry, DynamicDrawUsage, LineBasicMaterial, LineSegments } from '../vendor/three.js';
import { COLUMNS } from '../fleet_frame.js';
import { colourOf } from './vehicle_meshes.js';

const STEPS = 240; // of a trail; fewer of many vehicles
const MOST = 12000; // segments of all trails
const PERIOD = 0.25; // s of simulated time between two points
const JUMP = 5; // m; a vehicle that moves more has been put there

export class Trails {
  lines = null;
  #count = 0;
  #last = null;
  #time = -Infinity;
  #step = 0;
  #steps = STEPS;

  /** Restarts for a number of vehicles; returns the lines. */
  begin(count) {
    this.#count = count;
    this.#steps = Math.min(STEPS, Math.floor(MOST / Math.max(count, 1)));
    this.#last = null;
    this.#step = 0;
    const geometry = new BufferGeometry();
    geometry.setAttribute('position', new BufferAttribute(new Float32Array(6 * count * this.#steps), 3).setUsage(DynamicDrawUsage));
    const colours = new Float32Array(6 * count * this.#steps);
    for (let i = 0; i < 2 * count * this.#steps; i++) colourOf(Math.floor(i / 2) % count).toArray(colours, 3 * i);
    geometry.setAttribute('color', new BufferAttribute(colours, 3));
    geometry.setDrawRange(0, 0);
    this.lines = new LineSegments(geometry, new LineBasicMaterial({ vertexColors: true, transparent: true, opacity: 0.75 }));
    this.lines.frustumCulled = false;
    return this.lines;
  }

  /** Takes a frame's rows at a simulated time. */
  push(rows, time) {
    if (!this.lines || rows.length !== this.#count * COLUMNS) return;
    if (time < this.#time) this.#clear(); // a reset, or an earlier moment of a recording
    if (this.#last && time - this.#time < PERIOD) return;
    if (this.#last) this.#write(rows);
    this.#last = rows.slice();
    this.#time = time;
  }

  #clear() {
    this.#last = null;
    this.#step = 0;
    this.lines.geometry.setDrawRange(0, 0);
  }

  #write(rows) {
    const attribute = this.lines.geometry.attributes.position;
    const size = 6 * this.#count;
    const start = (this.#step % this.#steps) * size;
    for (let i = 0; i < this.#count; i++) {
      const jumped = !(distance(rows, this.#last, i * COLUMNS) < JUMP);
      for (let k = 0; k < 3; k++) {
        attribute.array[start + 6 * i + 3 + k] = rows[i * COLUMNS + k] || 0;
        attribute.array[start + 6 * i + k] = (jumped ? rows : this.#last)[i * COLUMNS + k] || 0;
      }
    }
    attribute.addUpdateRange(start, size);
    attribute.needsUpdate = true;
    this.#step += 1;
    this.lines.geometry.setDrawRange(0, 2 * this.#count * Math.min(this.#step, this.#steps));
  }
}

function distance(a, b, i) { return Math.hypot(a[i] - b[i], a[i + 1] - b[i + 1], a[i + 2] - b[i + 2]); }
