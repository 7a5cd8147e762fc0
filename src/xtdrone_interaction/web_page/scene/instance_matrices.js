// Matrices of instances, written in place: a hundred vehicles make no object in a frame.
import { COLUMNS } from '../fleet_frame.js';

/** Writes the matrix of a row's pose (x, y, z, quaternion w, x, y, z) as column 16 * index of an array. */
export function writePose(array, index, rows, row) {
  const at = 16 * index;
  const from = row * COLUMNS;
  const w = rows[from + 3], x = rows[from + 4], y = rows[from + 5], z = rows[from + 6];
  array[at] = 1 - 2 * (y * y + z * z); array[at + 1] = 2 * (x * y + w * z); array[at + 2] = 2 * (x * z - w * y); array[at + 3] = 0;
  array[at + 4] = 2 * (x * y - w * z); array[at + 5] = 1 - 2 * (x * x + z * z); array[at + 6] = 2 * (y * z + w * x); array[at + 7] = 0;
  array[at + 8] = 2 * (x * z + w * y); array[at + 9] = 2 * (y * z - w * x); array[at + 10] = 1 - 2 * (x * x + y * y); array[at + 11] = 0;
  array[at + 12] = rows[from]; array[at + 13] = rows[from + 1]; array[at + 14] = rows[from + 2]; array[at + 15] = 1;
}

/** Writes the matrix of a part at [x, y, z] of a body, turned by an angle about the body's z axis. */
export function writeTurned(array, index, bodies, body, place, angle) {
  const at = 16 * index;
  const m = 16 * body;
  const c = Math.cos(angle), s = Math.sin(angle);
  for (let k = 0; k < 3; k++) {
    const x = bodies[m + k], y = bodies[m + 4 + k], z = bodies[m + 8 + k];
    array[at + k] = c * x + s * y;
    array[at + 4 + k] = c * y - s * x;
    array[at + 8 + k] = z;
    array[at + 12 + k] = x * place[0] + y * place[1] + z * place[2] + bodies[m + 12 + k];
  }
  array[at + 3] = array[at + 7] = array[at + 11] = 0;
  array[at + 15] = 1;
}
