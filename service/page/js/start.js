/** Starts the page where the browser can draw it; otherwise what works without stays in its place. */

if (document.createElement("canvas").getContext("webgl2")) {
  document.documentElement.classList.add("draws");
  await import("./main.js");
}
