/** Starts the page if the browser can draw it; otherwise the parts that work without drawing stay. */

// Only the viewer, for a frame in another page.
if (new URLSearchParams(location.search).has("embed")) document.documentElement.classList.add("embed");

if (document.createElement("canvas").getContext("webgl2")) {
  document.documentElement.classList.add("draws");
  await import("./main.js");
}

export {};
