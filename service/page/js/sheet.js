/** The height of the controls on a phone: the user drags a handle, presses it, or moves it by keys. */

const STOPS = [0, 0.46, 0.8]; // shares of the height below the header; the first leaves the tabs
const PRESS = 6; // pixels; a shorter movement is a press

/**
 * @param {HTMLElement} handle
 * @param {HTMLElement} main holds the shape and the controls
 */
export function sheet(handle, main) {
  let share = STOPS[1];
  let from = null;
  const set = (to) => {
    share = Math.min(Math.max(to, STOPS[0]), STOPS.at(-1));
    main.style.setProperty("--sheet", `${100 * share}%`);
    handle.setAttribute("aria-valuenow", String(Math.round(100 * share)));
  };
  const nearest = () => STOPS.indexOf(STOPS.toSorted((a, b) => Math.abs(a - share) - Math.abs(b - share))[0]);
  set(share);
  handle.addEventListener("pointerdown", (event) => {
    handle.setPointerCapture(event.pointerId);
    from = { y: event.clientY, share };
  });
  handle.addEventListener("pointermove", ({ clientY }) => {
    if (from) set(from.share + (from.y - clientY) / main.clientHeight);
  });
  handle.addEventListener("pointerup", ({ clientY }) => {
    if (!from) return;
    if (Math.abs(clientY - from.y) < PRESS) set(STOPS[(nearest() + 1) % STOPS.length]);
    else set(STOPS[nearest()]);
    from = null;
  });
  handle.addEventListener("pointercancel", () => {
    set(STOPS[nearest()]);
    from = null;
  });
  handle.addEventListener("keydown", (event) => {
    const last = STOPS.length - 1;
    const to = { ArrowUp: nearest() + 1, ArrowDown: nearest() - 1, Home: 0, End: last }[event.key];
    if (to === undefined) return;
    event.preventDefault();
    set(STOPS[Math.min(Math.max(to, 0), last)]);
  });
}
