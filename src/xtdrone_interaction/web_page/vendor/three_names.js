// What the page uses of three.js; README.md tells how three.js beside it is made from this list.
export {
  AmbientLight, AxesHelper, Box3, BoxGeometry, BufferAttribute, BufferGeometry, CanvasTexture, CircleGeometry, Color,
  ConeGeometry, CylinderGeometry, DataTexture, DirectionalLight, DoubleSide, DynamicDrawUsage, Euler, Fog, GridHelper,
  Group, HemisphereLight, InstancedMesh, Line, LineBasicMaterial, LineLoop, LineSegments, Matrix4, Mesh,
  MeshBasicMaterial, MeshLambertMaterial, MeshStandardMaterial, Object3D, OrthographicCamera, PerspectiveCamera, Plane,
  PlaneGeometry, Points, PointsMaterial, Quaternion, Raycaster, RepeatWrapping, RingGeometry, Scene, Shape,
  ShapeGeometry, SphereGeometry, Sprite, SpriteMaterial, SRGBColorSpace, Texture, TorusGeometry, Vector2, Vector3,
  Vector4, WebGLRenderer,
} from 'three';
export { MapControls } from 'three/examples/jsm/controls/MapControls.js';
export { OrbitControls } from 'three/examples/jsm/controls/OrbitControls.js';
