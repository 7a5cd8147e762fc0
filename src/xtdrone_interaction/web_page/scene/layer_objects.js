// Clouds, lines and grids of layers in the scene, one draw call each; clouds and lines are coloured by height.
import {
  BufferAttribute, BufferGeometry, DataTexture, DynamicDrawUsage, Group, Line, LineBasicMaterial, Mesh, MeshBasicMaterial, PlaneGeometry,
  Points, PointsMaterial,
} from '../vendor/three.js';
import { UNKNOWN } from '../layers/layer_frame.js';

const STEPS = 65535;
const LEAST_SPAN = 2; // m of the colour scale
const RAMP = `
vec3 heightColour(float share) {
  return clamp(vec3(1.5 - abs(4.0 * share - 3.0), 1.5 - abs(4.0 * share - 2.0), 1.5 - abs(4.0 * share - 1.0)), 0.12, 1.0);
}`;

export class LayerObjects {
  group = new Group();
  #objects = new Map(); // topic -> {object, low, high}
  #span = { low: { value: 0 }, high: { value: LEAST_SPAN } }; // of the heights of all layers, m

  /** Shows a topic's newest frame. */
  set(topic, frame) {
    let entry = this.#objects.get(topic);
    if (entry && entry.kind !== frame.kind) { this.remove(topic); entry = undefined; }
    if (!entry) {
      entry = { kind: frame.kind, object: this.#object(frame.kind), low: 0, high: 0 };
      this.#objects.set(topic, entry);
      this.group.add(entry.object);
    }
    if (frame.kind === 'grid') fillGrid(entry.object, frame);
    else {
      fillPlaces(entry.object, frame);
      [entry.low, entry.high] = [frame.origin[2], frame.origin[2] + frame.extent[2]];
    }
    this.#setSpan();
  }

  remove(topic) {
    const entry = this.#objects.get(topic);
    if (!entry) return;
    this.#objects.delete(topic);
    this.group.remove(entry.object);
    entry.object.geometry.dispose();
    entry.object.material.map?.dispose();
    entry.object.material.dispose();
    this.#setSpan();
  }

  /** Returns what is shown of a topic, for tests: its kind, number of points or cells, and lowest corner, m. */
  describe(topic) {
    const entry = this.#objects.get(topic);
    return entry && { kind: entry.kind, ...entry.object.userData };
  }

  #object(kind) {
    if (kind === 'grid') {
      const material = new MeshBasicMaterial({ transparent: true, depthWrite: false });
      const mesh = new Mesh(new PlaneGeometry(1, 1).translate(0.5, 0.5, 0), material); // from the origin on
      mesh.renderOrder = -1;
      return mesh;
    }
    const object = kind === 'line' ? new Line(new BufferGeometry(), this.#coloured(new LineBasicMaterial()))
      : new Points(new BufferGeometry(), this.#coloured(new PointsMaterial({ size: 3, sizeAttenuation: false })));
    object.frustumCulled = false;
    return object;
  }

  /** Lets a material take its colour from the height in the world. */
  #coloured(material) {
    material.onBeforeCompile = (shader) => {
      shader.uniforms.lowest = this.#span.low;
      shader.uniforms.highest = this.#span.high;
      shader.vertexShader = shader.vertexShader
        .replace('void main() {', 'uniform float lowest;\nuniform float highest;\nvarying float heightShare;\nvoid main() {')
        .replace('#include <project_vertex>', '#include <project_vertex>\n'
          + '  heightShare = clamp(((modelMatrix * vec4(transformed, 1.0)).z - lowest) / (highest - lowest), 0.0, 1.0);');
      shader.fragmentShader = shader.fragmentShader
        .replace('void main() {', `varying float heightShare;\n${RAMP}\nvoid main() {`)
        .replace('#include <color_fragment>', 'diffuseColor.rgb = heightColour(heightShare);');
    };
    return material;
  }

  #setSpan() {
    const shown = [...this.#objects.values()].filter(({ kind }) => kind !== 'grid');
    if (!shown.length) return;
    this.#span.low.value = Math.min(...shown.map(({ low }) => low));
    this.#span.high.value = Math.max(...shown.map(({ high }) => high), this.#span.low.value + LEAST_SPAN);
  }
}

/** Sets places as they came: the graphics turn the steps into m by the object's scale. */
function fillPlaces(object, { places, origin, extent, total }) {
  const { geometry } = object;
  const known = geometry.attributes.position;
  if (!known || known.array.length < places.length) {
    geometry.dispose(); // a larger buffer
    geometry.setAttribute('position', new BufferAttribute(places.slice(), 3, true).setUsage(DynamicDrawUsage));
  } else {
    known.array.set(places);
    known.clearUpdateRanges();
    known.addUpdateRange(0, places.length);
    known.needsUpdate = true;
  }
  geometry.setDrawRange(0, places.length / 3);
  object.position.set(...origin);
  object.scale.set(...extent);
  object.userData = { count: places.length / 3, total, origin, extent, steps: STEPS };
}

/** Paints a grid's cells: dark where occupied, light where free, not at all where unknown. */
function fillGrid(mesh, { cells, columns, rows, side, origin, orientation }) {
  const { material } = mesh;
  const fits = material.map?.image.width === columns && material.map.image.height === rows;
  const pixels = fits ? material.map.image.data : new Uint8Array(4 * cells.length);
  paintCells(cells, pixels);
  if (!fits) {
    material.map?.dispose();
    material.map = new DataTexture(pixels, columns, rows);
    material.needsUpdate = true;
  }
  material.map.needsUpdate = true;
  const [w, x, y, z] = orientation;
  mesh.position.set(origin[0], origin[1], origin[2] + 0.02); // above the ground
  mesh.quaternion.set(x, y, z, w);
  mesh.scale.set(columns * side, rows * side, 1);
  mesh.userData = { count: cells.length, occupied: cells.reduce((sum, cell) => sum + (cell > 50 && cell !== UNKNOWN), 0), origin };
}

/** Writes the colours of cells, four bytes each. */
export function paintCells(cells, pixels) {
  for (let i = 0; i < cells.length; i++) {
    const cell = cells[i];
    const share = cell === UNKNOWN ? 0 : cell / 100;
    pixels[4 * i] = 235 - 205 * share;
    pixels[4 * i + 1] = 240 - 170 * share;
    pixels[4 * i + 2] = 245 - 125 * share;
    pixels[4 * i + 3] = cell === UNKNOWN ? 0 : 110 + 110 * share;
  }
  return pixels;
}
