// A mesh of fewer triangles for vehicles that are far: corners that are in one cell of a grid become one.
import { BufferAttribute, BufferGeometry } from '../vendor/three.js';

/**
 * @param {BufferGeometry} geometry not indexed, with position and color
 * @param {number} cells along the longest side of the mesh
 * @returns {BufferGeometry} not indexed, with position, normal (flat) and color
 */
export function simplerMesh(geometry, cells) {
  geometry.computeBoundingBox();
  const { min, max } = geometry.boundingBox;
  const side = Math.max(max.x - min.x, max.y - min.y, max.z - min.z) / cells || 1;
  const position = geometry.attributes.position.array;
  const colour = geometry.attributes.color.array;
  const cellOf = new Map(); // key of a cell -> its number
  const sums = []; // of each cell: x, y, z and number of its corners
  const corners = new Uint32Array(position.length / 3);
  for (let i = 0; i < corners.length; i++) {
    const key = Math.floor((position[3 * i] - min.x) / side) + 1024 * (Math.floor((position[3 * i + 1] - min.y) / side)
      + 1024 * Math.floor((position[3 * i + 2] - min.z) / side));
    let cell = cellOf.get(key);
    if (cell === undefined) { cell = sums.length / 4; cellOf.set(key, cell); sums.push(0, 0, 0, 0); }
    corners[i] = cell;
    for (let k = 0; k < 3; k++) sums[4 * cell + k] += position[3 * i + k];
    sums[4 * cell + 3] += 1;
  }
  const kept = [];
  const seen = new Set();
  for (let i = 0; i < corners.length; i += 3) {
    const [a, b, c] = [corners[i], corners[i + 1], corners[i + 2]];
    if (a === b || b === c || c === a) continue;
    const key = [a, b, c].sort((x, y) => x - y).join();
    if (!seen.has(key)) { seen.add(key); kept.push(i); }
  }
  const arrays = [new Float32Array(9 * kept.length), new Float32Array(9 * kept.length)];
  kept.forEach((first, n) => {
    for (let corner = 0; corner < 3; corner++) {
      const cell = 4 * corners[first + corner];
      for (let k = 0; k < 3; k++) {
        arrays[0][9 * n + 3 * corner + k] = sums[cell + k] / sums[cell + 3];
        arrays[1][9 * n + 3 * corner + k] = colour[3 * (first + corner) + k];
      }
    }
  });
  const simpler = new BufferGeometry();
  simpler.setAttribute('position', new BufferAttribute(arrays[0], 3));
  simpler.setAttribute('color', new BufferAttribute(arrays[1], 3));
  simpler.computeVertexNormals();
  return simpler;
}
