// The fleet's motion between two frames: the page draws more often than the station sends.
import { COLUMNS } from '../fleet_frame.js';

const LONGEST = 400; // ms between two frames over which to interpolate; more is a pause

/** Interpolates rows of x, y, z, quaternion w, x, y, z. */
export class Motion {
  #before = null;
  #after = null;
  #spare = null;
  #shown = null;
  #at = 0;
  #span = 100;

  /** Takes a frame's rows, at a time of performance.now(). */
  push(rows, now) {
    const same = this.#after?.length === rows.length;
    if (!same) [this.#before, this.#spare, this.#shown] = [rows, new Float32Array(rows.length), new Float32Array(rows.length)];
    else {
      const before = this.#interpolate(now, this.#spare);
      this.#spare = this.#before.length === rows.length && this.#before !== this.#after ? this.#before : new Float32Array(rows.length);
      this.#before = before;
    }
    this.#span = Math.min(Math.max(now - this.#at, 20), LONGEST);
    this.#after = rows;
    this.#at = now;
  }

  /** Returns the rows at a time of performance.now(), in an array that the next call writes again. */
  now(time) { return this.#interpolate(time, this.#shown); }

  /** Tells whether the rows still change at a time of performance.now(). */
  moves(time) { return this.#after !== null && time - this.#at < this.#span; }

  /** Tells for how long no frame has come, ms. */
  silence(time) { return time - this.#at; }

  get rows() { return this.#after; }

  #interpolate(time, out) {
    const share = Math.min((time - this.#at) / this.#span, 1);
    const [before, after] = [this.#before, this.#after];
    for (let i = 0; i < after.length; i += COLUMNS) {
      for (let k = i; k < i + COLUMNS; k++) out[k] = before[k] + share * (after[k] - before[k]);
      turn(before, after, i + 3, share, out);
    }
    return out;
  }
}

/** Interpolates a quaternion along the shorter way. */
function turn(before, after, i, share, out) {
  let dot = 0;
  for (let k = i; k < i + 4; k++) dot += before[k] * after[k];
  const sign = dot < 0 ? -1 : 1;
  let norm = 0;
  for (let k = i; k < i + 4; k++) {
    out[k] = before[k] + share * (sign * after[k] - before[k]);
    norm += out[k] * out[k];
  }
  norm = Math.sqrt(norm) || 1;
  for (let k = i; k < i + 4; k++) out[k] /= norm;
}
