/**
 * What the page says about each type of the server's problems. The server's own sentences are for programs:
 * they name parameters and headers.
 */

const RELOAD = "Load the page again. If that does not help, tell the people who run this server.";
const LATER = "Try again in a moment.";
const ADDRESS = "Open the page at the address that the server prints when it starts.";
const NUMBERS = "Check the numbers, or press Reset all.";

/** @type {Record<string, string>} */
export const TEXTS = {
  "malformed-request": `The server could not read what the page sent. ${RELOAD}`,
  unauthorized: "The server asks for a key. Load the page again and enter the key.",
  "cross-origin": `The server refuses requests from this address. ${ADDRESS}`,
  "not-found": `The server does not know what the page asked for. ${RELOAD}`,
  "unknown-model":
    "The server does not have this model any more. Load the page again and choose another model.",
  "unknown-version":
    "The server has replaced this version of the model. Load the page again to use the new version.",
  "unknown-interpolation": "The server can’t play this path. Add its keyframes again.",
  "unknown-frame": "The path has no such frame. Add its keyframes again.",
  "method-not-allowed": `The server does not accept this request. ${RELOAD}`,
  "not-acceptable": "The server can’t write this format. Choose another format.",
  "request-timeout": `The connection is too slow: the server waited too long for the file. ${LATER}`,
  "body-too-large":
    "This is more than the server accepts at once. Open a smaller file, or use fewer keyframes.",
  "unsupported-media-type":
    "This file type is not supported. Save a mesh as .obj, .ply, .stl or .glb, or points as .xyz.",
  misdirected: `The server does not know this address. ${ADDRESS}`,
  "invalid-request": `The server refuses what the page asked for. ${RELOAD}`,
  "wrong-length": `The model has another number of coordinates than the page sent. ${RELOAD}`,
  "not-finite": `A number is too large for a shape. ${NUMBERS}`,
  "out-of-bounds": `A number is outside the range of the model. ${NUMBERS}`,
  "invalid-mesh": "Export the file again from the program that made it.",
  "invalid-scan": "Export the scan again, with points from all of the surface.",
  "no-tangent-space": "This model can’t compute exact shapes.",
  "no-such-range": "The file has no such part. Reload the page and try again.",
  periodic: "This model has angles that go round, so it has no blend shapes.",
  "too-many-codes": "This is more shapes than the server computes at once. Use fewer keyframes.",
  "too-many-frames": "The animation is too long for the server. Use fewer keyframes.",
  "path-too-long": "The path has too many keyframes for its address. Remove some keyframes.",
  "head-too-large": "The address is too long for the server. Remove some keyframes.",
  "client-closed": `The connection ended before the answer. ${LATER}`,
  "internal-error": "The server has made a mistake. Try something else, and tell the people who run it.",
  busy: `The server is busy. ${LATER}`,
  "not-ready": `The server is starting or stopping. ${LATER}`,
  "model-failed": "The model gives no shape here. Undo the last change, or press Reset all.",
  "deadline-passed":
    "The server did not finish in time. Try again. For a scan, use fewer points: a few thousand are enough.",
  "no-room": `The disk of the server is full. ${LATER}`,
};

/** Types with a first sentence about the user's file, which is for everybody. */
const ABOUT_FILES = ["invalid-mesh", "invalid-scan"];
/** Marks of a sentence that is for programs. */
const FOR_PROGRAMS = /[?=&{}`]|\bfit\b|Content-Type/;

/** Return the page's sentences about a problem of the server (RFC 9457). */
export function inWords({ type = "", detail = "" }, status) {
  const kind = type.split(":").at(-1);
  const text = TEXTS[kind] ?? `The server answers with the status ${status}. ${RELOAD}`;
  const [first] = detail.split(/(?<=[.!])\s/);
  if (!ABOUT_FILES.includes(kind)) return text;
  const why = first && !FOR_PROGRAMS.test(first) ? first : "The server can’t use this file.";
  return `${why} ${text}`;
}
