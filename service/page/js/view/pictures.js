/** Small pictures of shapes, all drawn by one renderer outside the page. */

import * as THREE from "three";
import {
  face,
  frame,
  geometryOf,
  litCamera,
  move,
  paint,
  sideOf,
  sphereOf,
  surfaceMaterial,
} from "./scene.js";

const LEAST = 0.36; // least share of the shape's radius in a picture, so that a part has surroundings

export class Pictures {
  #renderer = null; // made with the first picture, because it takes longer than all else here

  constructor() {
    this.camera = litCamera();
    this.mesh = new THREE.Mesh(new THREE.BufferGeometry(), surfaceMaterial());
    this.mesh.frustumCulled = false;
    this.scene = new THREE.Scene();
    this.scene.add(this.camera, this.mesh);
  }

  open({ vertices, faces }) {
    this.mesh.geometry.dispose();
    this.mesh.geometry = geometryOf(faces, vertices.length / 3);
    face(this.mesh.material, sideOf(faces, vertices.length / 3));
    const { center, radius } = sphereOf(vertices);
    this.sphere = { center, radius: 0.95 * radius };
  }

  /** Draw a shape, or its part inside a sphere, into a canvas of the page. */
  draw(canvas, positions, colours, part) {
    const { width, height } = canvas;
    this.#renderer ??= new THREE.WebGLRenderer({ antialias: true, alpha: true, preserveDrawingBuffer: true });
    this.#renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    const { center, radius } = part ?? this.sphere;
    frame(this.camera, { center, radius: Math.max(radius, LEAST * this.sphere.radius) });
    move(this.mesh.geometry, positions);
    paint(this.mesh.geometry, colours);
    this.#renderer.render(this.scene, this.camera);
    const context = canvas.getContext("2d");
    context.clearRect(0, 0, width, height);
    context.drawImage(this.#renderer.domElement, 0, 0);
    canvas.classList.add("drawn");
  }
}
