// Geometries of the shapes that the station describes: primitives of unit size, meshes, and vehicles as one mesh.
import {
  BoxGeometry, BufferAttribute, BufferGeometry, Color, CylinderGeometry, Matrix4, Quaternion, RepeatWrapping, SphereGeometry,
  SRGBColorSpace, Texture, Vector3,
} from '../vendor/three.js';

const AROUND = 10; // corners of a circle: few, as a hundred vehicles have thousands

/** Decodes base64 of little-endian float32. */
function floats(text) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  return new Float32Array(bytes.buffer);
}

/** Returns the matrix of a pose [x, y, z, w, x, y, z] and a scale. */
export function matrixOf(pose, size = [1, 1, 1]) {
  const [x, y, z, qw, qx, qy, qz] = pose;
  return new Matrix4().compose(new Vector3(x, y, z), new Quaternion(qx, qy, qz, qw), new Vector3(...size));
}

export class Shapes {
  #station;
  #geometries = new Map();
  #textures = new Map();
  #turn = Promise.resolve(); // after the last call: the station refuses many at once

  constructor(station) { this.#station = station; }

  /** Returns the promise of a shape's geometry at unit size. */
  geometry({ kind, mesh }) {
    const key = kind === 'mesh' ? `mesh ${mesh}` : kind;
    if (!this.#geometries.has(key)) this.#geometries.set(key, this.#make(kind, mesh));
    return this.#geometries.get(key);
  }

  /** Returns the promise of a texture. */
  texture(number) {
    if (!this.#textures.has(number)) this.#textures.set(number, this.#load(number));
    return this.#textures.get(number);
  }

  #call(method, params) {
    const answer = this.#turn.then(() => this.#station.call(method, params));
    this.#turn = answer.catch(() => {});
    return answer;
  }

  async #make(kind, number) {
    if (kind === 'box') return new BoxGeometry(1, 1, 1);
    if (kind === 'sphere') return new SphereGeometry(1, 12, 8).rotateX(Math.PI / 2);
    if (kind === 'cylinder') return new CylinderGeometry(1, 1, 1, AROUND).rotateX(Math.PI / 2);
    const { points, normals, uv } = await this.#call('world.mesh', { number });
    const geometry = new BufferGeometry();
    geometry.setAttribute('position', new BufferAttribute(floats(points), 3));
    geometry.setAttribute('normal', new BufferAttribute(floats(normals), 3));
    geometry.setAttribute('uv', new BufferAttribute(floats(uv), 2));
    return geometry;
  }

  async #load(number) {
    const image = new Image();
    image.src = await this.#call('world.texture', { number });
    await image.decode();
    const texture = new Texture(image);
    texture.colorSpace = SRGBColorSpace;
    texture.wrapS = texture.wrapT = RepeatWrapping;
    texture.needsUpdate = true;
    return texture;
  }

  /** Returns shapes, each with the matrix of its pose and size, as one geometry with colours at its corners. */
  async merged(placed) {
    const parts = await Promise.all(placed.map(async ({ shape, matrix }) => ({
      geometry: plain(await this.geometry(shape)).applyMatrix4(matrix),
      colour: new Color().setRGB(...shape.colour.slice(0, 3), SRGBColorSpace),
    })));
    const count = parts.reduce((sum, { geometry }) => sum + geometry.attributes.position.count, 0);
    const arrays = { position: new Float32Array(3 * count), normal: new Float32Array(3 * count), color: new Float32Array(3 * count), uv: new Float32Array(2 * count) };
    let at = 0;
    for (const { geometry, colour } of parts) {
      const size = geometry.attributes.position.count;
      arrays.position.set(geometry.attributes.position.array, 3 * at);
      arrays.normal.set(geometry.attributes.normal.array, 3 * at);
      if (geometry.attributes.uv) arrays.uv.set(geometry.attributes.uv.array, 2 * at);
      for (let i = at; i < at + size; i++) colour.toArray(arrays.color, 3 * i);
      at += size;
    }
    const whole = new BufferGeometry();
    for (const [name, array] of Object.entries(arrays)) whole.setAttribute(name, new BufferAttribute(array, name === 'uv' ? 2 : 3));
    return whole;
  }
}

/** Returns a copy without an index. */
function plain(geometry) { return geometry.index ? geometry.toNonIndexed() : geometry.clone(); }

/** Empties a group and frees what its objects have in the graphics; textures, which are shared, stay. */
export function release(group) {
  group.traverse((object) => {
    object.geometry?.dispose();
    object.material?.dispose();
    if (object.isInstancedMesh) object.dispose();
  });
  group.clear();
}
