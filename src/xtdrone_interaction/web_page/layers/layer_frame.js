// The binary frame of a layer, as xtdrone_interaction/web/layers/layer_frame.py packs it.
export const LAYER = 3; // its channel
export const UNKNOWN = 255; // a cell's value
export const KINDS = { 1: 'points', 2: 'line', 3: 'grid' };
const HEADER = 80;

/**
 * @param {ArrayBuffer} buffer the whole frame
 * @returns {{kind: string, subscription: number, time: number, origin: number[], ...}} origin in m ENU;
 *   of points and lines: `places` (Uint16Array of x, y, z in 1/65535 of `extent`, m) and `total`, points of the message;
 *   of grids: `columns`, `rows`, `side` (m), `orientation` (w, x, y, z), `cells` (Uint8Array, rows along x)
 */
export function readLayerFrame(buffer) {
  const view = new DataView(buffer);
  if (view.getUint8(1) !== 1) throw new Error(`layer frame: version ${view.getUint8(1)} is not allowed, 1`);
  const kind = KINDS[view.getUint8(2)];
  const numbers = (at, count, size, get) => Array.from({ length: count }, (_, i) => view[get](at + size * i, true));
  const [n, m] = numbers(16, 2, 4, 'getUint32');
  const frame = { kind, subscription: view.getUint32(4, true), time: view.getFloat64(8, true), origin: numbers(24, 3, 8, 'getFloat64') };
  const extent = numbers(48, 3, 4, 'getFloat32');
  if (kind !== 'grid') return { ...frame, extent, total: m, places: new Uint16Array(buffer, HEADER, 3 * n) };
  return { ...frame, columns: n, rows: m, side: extent[0], orientation: numbers(60, 4, 4, 'getFloat32'), cells: new Uint8Array(buffer, HEADER, n * m) };
}
