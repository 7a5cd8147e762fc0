// The fleet's binary frame, as xtdrone_interaction/web/fleet/fleet_frame.py packs it.
const HEADER = 24;
export const COLUMNS = 10;

/**
 * @param {ArrayBuffer} buffer the whole frame
 * @returns {{time: number, roster: number, number: number, vehicles: Float32Array, movers: Float32Array}}
 *   rows of x, y, z (m ENU), quaternion w, x, y, z, velocity vx, vy, vz (m/s)
 */
export function readFleetFrame(buffer) {
  const view = new DataView(buffer);
  if (view.getUint8(1) !== 1) throw new Error(`fleet frame: version ${view.getUint8(1)} is not allowed, 1`);
  const vehicles = view.getUint16(2, true);
  const movers = view.getUint16(4, true);
  const rows = new Float32Array(buffer, HEADER, (vehicles + movers) * COLUMNS);
  return {
    time: view.getFloat64(8, true),
    roster: view.getUint32(16, true),
    number: view.getUint32(20, true),
    vehicles: rows.subarray(0, vehicles * COLUMNS),
    movers: rows.subarray(vehicles * COLUMNS),
  };
}
