/** Dark or light: as the system says, until the user chooses. */

import { always } from "./memory.js";

export function theme(button, viewer) {
  const root = document.documentElement;
  const system = matchMedia("(prefers-color-scheme: dark)");
  const kept = always.kept("theme");
  if (kept) root.dataset.theme = kept;
  viewer.recolour();
  system.addEventListener("change", () => viewer.recolour());
  button.addEventListener("click", () => {
    const isDark = root.dataset.theme ? root.dataset.theme === "dark" : system.matches;
    root.dataset.theme = isDark ? "light" : "dark";
    always.keep("theme", root.dataset.theme);
    viewer.recolour();
  });
}
