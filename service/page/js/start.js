/** Starts the page where the browser can draw it; otherwise what works without stays in its place. */

// The viewer alone, for a frame in another page.
if (new URLSearchParams(location.search).has("embed")) document.documentElement.classList.add("embed");

if (document.createElement("canvas").getContext("webgl2")) {
  document.documentElement.classList.add("draws");
  await import("./main.js");
}

export {};
