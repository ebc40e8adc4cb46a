// A stage for robots: camera, ground, and robots built from what drawing.skeleton() gives. Draws only on change.
import { THREE, OrbitControls } from "nicegui-scene";

// cividis, which colour-blind readers and grey printers order alike
export const SCALE = ["#00224e", "#2a3f6d", "#575d6d", "#7d7c78", "#a69d75", "#d3c064", "#fee838"];

export function scaled(share) {
  const at = Math.max(0, Math.min(0.9999, share)) * (SCALE.length - 1);
  const low = new THREE.Color(SCALE[Math.floor(at)]);
  return low.lerp(new THREE.Color(SCALE[Math.floor(at) + 1]), at % 1);
}

function geometry(shape) {
  const [a, b, c] = shape.size;
  if (shape.kind === "box") return new THREE.BoxGeometry(2 * a, 2 * b, 2 * c);
  if (shape.kind === "sphere") return new THREE.SphereGeometry(a, 18, 12);
  const round =
    shape.kind === "capsule"
      ? new THREE.CapsuleGeometry(a, 2 * b, 6, 14)
      : new THREE.CylinderGeometry(a, a, 2 * b, 20);
  return round.rotateX(Math.PI / 2); // along z, as MuJoCo has it
}

const quaternion = ([w, x, y, z]) => new THREE.Quaternion(x, y, z, w);

export class Robot {
  constructor(skeleton, { color, opacity = 1 }) {
    this.skeleton = skeleton;
    this.root = new THREE.Group();
    this.color = color;
    const bodies = new Map([[0, this.root]]);
    this.turning = [];
    for (const body of skeleton.bodies) {
      const node = new THREE.Group();
      node.position.set(...body.position);
      const rest = quaternion(body.quaternion);
      node.quaternion.copy(rest);
      bodies.get(body.parent).add(node);
      bodies.set(body.index, node);
      if (skeleton.floating && body.parent === 0 && body.joint < 0 && !this.base && body.name === "base_link") this.base = node;
      if (body.joint >= 0) this.turning.push({ node, rest, joint: body.joint, axis: new THREE.Vector3(...body.axis) });
    }
    this.shapes = skeleton.shapes.map((shape) => {
      const material = new THREE.MeshLambertMaterial({ color });
      if (opacity < 1) Object.assign(material, { transparent: true, opacity, depthWrite: false });
      const mesh = new THREE.Mesh(geometry(shape), material);
      mesh.position.set(...shape.position);
      mesh.quaternion.copy(quaternion(shape.quaternion));
      mesh.renderOrder = opacity < 1 ? 1 : 0;
      mesh.userData.joint = shape.joint;
      bodies.get(shape.body).add(mesh);
      return mesh;
    });
  }

  // base: [x, y, z, w, qx, qy, qz] at `b` of an array, joint angles (rad) at `j` of another
  pose(base, b, joints, j) {
    if (this.base && Number.isFinite(base[b])) {
      this.base.position.set(base[b], base[b + 1], base[b + 2]);
      this.base.quaternion.set(base[b + 4], base[b + 5], base[b + 6], base[b + 3]);
    }
    const turn = new THREE.Quaternion();
    for (const { node, rest, joint, axis } of this.turning) {
      const angle = joints[j + joint];
      if (!Number.isFinite(angle)) continue;
      node.quaternion.copy(rest).multiply(turn.setFromAxisAngle(axis, angle));
    }
  }

  // colour of each shape by its joint: a function from a joint's index to a colour, or null for its own
  paint(of) {
    for (const mesh of this.shapes) {
      const color = mesh.userData.joint < 0 ? null : of(mesh.userData.joint);
      mesh.material.color.set(color ?? this.color);
    }
  }

  dispose() {
    for (const mesh of this.shapes) {
      mesh.geometry.dispose();
      mesh.material.dispose();
    }
    this.root.removeFromParent();
  }
}

export class Stage {
  constructor(canvas) {
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true, alpha: true, preserveDrawingBuffer: true });
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    this.scene = new THREE.Scene();
    this.camera = new THREE.PerspectiveCamera(38, 1, 0.01, 20);
    this.camera.up.set(0, 0, 1);
    this.camera.position.set(0.57, -0.8, 0.52);
    this.scene.add(new THREE.HemisphereLight(0xffffff, 0x667080, 2.2));
    const sun = new THREE.DirectionalLight(0xffffff, 1.6);
    sun.position.set(1, -1, 2);
    this.scene.add(sun);
    this.ground = new THREE.Group();
    const grid = new THREE.GridHelper(1.6, 16, 0x8a929c, 0x8a929c);
    grid.material.transparent = true;
    grid.material.opacity = 0.35;
    grid.rotation.x = Math.PI / 2;
    this.ground.add(grid);
    this.blocks = new THREE.Group();
    this.ground.add(this.blocks);
    this.scene.add(this.ground);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.enablePan = false;
    this.controls.minDistance = 0.15;
    this.controls.maxDistance = 4;
    this.controls.addEventListener("change", () => this.ask());
    this.frames = 0;
    this.observer = new ResizeObserver(() => this.resize());
    this.observer.observe(canvas.parentElement);
    this.canvas = canvas;
    this.resize();
  }

  setGround(rotation, blocks) {
    this.ground.quaternion.copy(quaternion(rotation));
    this.blocks.clear();
    for (const block of blocks) {
      const mesh = new THREE.Mesh(
        new THREE.BoxGeometry(...block.size),
        new THREE.MeshLambertMaterial({ color: "#8a929c" }),
      );
      mesh.position.set(...block.center);
      mesh.rotation.z = block.yaw;
      this.blocks.add(mesh);
    }
    this.ask();
  }

  follow(x, y, z) {
    const move = new THREE.Vector3(x, y, z).sub(this.controls.target);
    this.controls.target.add(move);
    this.camera.position.add(move);
    this.controls.update();
  }

  // a rig that stays where it is, in the middle of the picture with room to swing
  frame(object) {
    const ball = new THREE.Box3().setFromObject(object).getBoundingSphere(new THREE.Sphere());
    const way = new THREE.Vector3(0.5, -0.8, 0.35).setLength(5 * ball.radius);
    this.controls.target.copy(ball.center);
    this.camera.position.copy(ball.center).add(way);
    this.controls.update();
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas.parentElement;
    if (!width || !height) return;
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.ask();
  }

  ask() {
    if (this.asked || this.closed) return;
    this.asked = true;
    requestAnimationFrame(() => {
      this.asked = false;
      if (this.closed) return;
      this.renderer.render(this.scene, this.camera);
      this.frames += 1;
    });
  }

  close() {
    this.closed = true;
    this.observer.disconnect();
    this.controls.dispose();
    this.renderer.dispose();
    this.renderer.forceContextLoss();
  }
}

// What pack.encode() wrote: header and named Float32Arrays
export async function load(url) {
  const answer = await fetch(url);
  if (!answer.ok) throw new Error(answer.status === 404 ? "this comparison has been removed; compare again" : answer.statusText);
  const data = await answer.arrayBuffer();
  const size = new DataView(data).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, size)));
  const arrays = {};
  let at = 4 + size;
  for (const { name, shape } of header.arrays) {
    const count = shape.reduce((a, b) => a * b, 1);
    arrays[name] = new Float32Array(data, at, count);
    at += 4 * count;
  }
  return { header, arrays };
}

export function savePicture(canvas, name) {
  const link = document.createElement("a");
  link.href = canvas.toDataURL("image/png");
  link.download = name;
  link.click();
}
