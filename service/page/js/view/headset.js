/** The shape in a headset, or in the room that a phone's camera sees (WebXR). */

import { Color } from "three";
import { reporting } from "../messages.js";

const RADIUS = 0.9; // m of the model's sphere, which is then as large as a person
const AWAY = 2.2; // m from the viewer to the middle of the shape
const NEAR = 0.02; // m
const FAR = 100; // m
/** Kinds of sessions with the button's title, the best first. @type {[XRSessionMode, string][]} */
const KINDS = [
  ["immersive-ar", "Show the shape in your room"],
  ["immersive-vr", "Show the shape in the headset"],
];

export class Headset {
  #kind = null;
  #before = null; // the view and the camera before the session

  /** `button` is shown where there is a headset, and begins or ends a session. */
  constructor(viewer, button) {
    this.viewer = viewer;
    this.button = button;
    this.xr = viewer.renderer.xr;
    this.xr.addEventListener("sessionend", () => this.#ended());
    const offer = () => this.#offer().catch(() => {}); // the browser may not let the page ask
    navigator.xr?.addEventListener("devicechange", offer);
    offer();
    button.setAttribute("aria-pressed", "false");
    button.addEventListener(
      "click",
      reporting(() => (this.#before ? this.xr.getSession().end() : this.#begin())),
    );
  }

  async #offer() {
    const { button } = this;
    if (document.documentElement.classList.contains("embed")) return; // has no buttons
    for (const [kind, title] of KINDS) {
      if (!(await navigator.xr?.isSessionSupported(kind))) continue;
      this.#kind = kind;
      button.title = title;
      button.setAttribute("aria-label", title);
      button.hidden = false;
      return;
    }
    button.hidden = true;
  }

  async #begin() {
    const { viewer, xr } = this;
    const { camera, canvas, renderer, rig, scene, sphere, stage, view } = viewer;
    const session = await navigator.xr.requestSession(this.#kind, { requiredFeatures: ["local-floor"] });
    const { fov, near, far } = camera;
    try {
      await xr.setSession(session);
    } catch (error) {
      session.end();
      throw error;
    }
    this.#before = { view, lens: { fov, near, far } };
    xr.enabled = true;
    Object.assign(camera, { near: NEAR, far: FAR });
    // The viewer stands in front of the shape, on its ground. The scale of the rig is that of the viewer.
    const scale = sphere.radius / RADIUS;
    rig.scale.setScalar(scale);
    rig.position.set(sphere.center.x, stage.position.y, sphere.center.z + scale * AWAY);
    if (this.#kind === "immersive-vr")
      scene.background = new Color(getComputedStyle(canvas.parentElement).backgroundColor);
    renderer.setAnimationLoop(() => viewer.render());
    this.button.setAttribute("aria-pressed", "true");
  }

  #ended() {
    const { viewer, xr } = this;
    viewer.renderer.setAnimationLoop(null);
    xr.enabled = false;
    viewer.scene.background = null;
    viewer.rig.scale.setScalar(1);
    viewer.rig.position.set(0, 0, 0);
    this.button.setAttribute("aria-pressed", "false");
    if (!this.#before) return;
    Object.assign(viewer.camera, this.#before.lens).scale.setScalar(1);
    viewer.camera.updateProjectionMatrix();
    viewer.view = this.#before.view;
    this.#before = null;
  }
}
