// The fleet's motion between two frames: the page draws more often than the station sends.
import { COLUMNS } from '../fleet.js';

const LONGEST = 400; // ms between two frames over which to interpolate; more is a pause

/** Interpolates rows of x, y, z, quaternion w, x, y, z. */
export class Motion {
  #before = null;
  #after = null;
  #at = 0;
  #span = 100;

  /** Takes a frame's rows, at a time of performance.now(). */
  push(rows, now) {
    const same = this.#after?.length === rows.length;
    this.#before = same ? this.now(now, new Float32Array(rows.length)) : rows;
    this.#span = Math.min(Math.max(now - this.#at, 20), LONGEST);
    this.#after = rows;
    this.#at = now;
  }

  /** Returns the rows at a time of performance.now(), in an array of the same length. */
  now(time, out) {
    const share = Math.min((time - this.#at) / this.#span, 1);
    const [before, after] = [this.#before, this.#after];
    for (let i = 0; i < after.length; i++) out[i] = before[i] + share * (after[i] - before[i]);
    for (let i = 0; i < after.length; i += COLUMNS) turn(before, after, i + 3, share, out);
    return out;
  }

  get rows() { return this.#after; }
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
