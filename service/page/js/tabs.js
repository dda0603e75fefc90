import { here } from "./memory.js";

/**
 * Tabs by the pattern of the WAI-ARIA practices: one tab stop, with arrow keys between tabs. A reload keeps
 * the selected tab.
 */
export function tabs(list) {
  const all = [...list.querySelectorAll("[role=tab]")];
  const select = (chosen) => {
    here.keep("tab", chosen.id);
    for (const tab of all) {
      const is = tab === chosen;
      tab.setAttribute("aria-selected", String(is));
      tab.tabIndex = is ? 0 : -1;
      document.getElementById(tab.getAttribute("aria-controls")).hidden = !is;
    }
  };
  for (const tab of all) tab.addEventListener("click", () => select(tab));
  select(all.find(({ id }) => id === here.kept("tab")) ?? all[0]);
  list.addEventListener("keydown", ({ key }) => {
    const at = all.indexOf(document.activeElement);
    const to = { ArrowRight: at + 1, ArrowLeft: at - 1, Home: 0, End: -1 }[key];
    if (at < 0 || to === undefined) return;
    const next = all.at(to % all.length);
    select(next);
    next.focus();
  });
}
