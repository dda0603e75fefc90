"""Modules joined into two files do what they do apart."""

import subprocess
from pathlib import Path

import pytest

from shapespace.page_scripts import joined_scripts

#: Modules with every form of import and export that the page has, which write what they have seen.
MODULES = {
    "low.js": "export const LOW = 1;\nexport class Low {\n  low = LOW;\n}\n",
    "server/calls.js": """import { LOW } from "../low.js";

export const seen = [`calls ${LOW}`];
export const name = () => "server";
export const shared = () => 3;
export async function* count() {
  yield (await import("../late.js")).late;
}
""",
    "static/calls.js": """import { seen } from "../server/calls.js";

export * from "../server/calls.js";

seen.push("static");
export const name = () => "files";
""",
    "late.js": """export const late = import.meta.url.split("/").slice(-2).join("/");\n""",
    "server/first.js": """import * as calls from "./calls.js";

export const begun = calls.name();
""",
    "place.js": """export const place = new URL("../vendor/", import.meta.url).href.split("/").at(-2);\n""",
    "main.js": """import { begun } from "./server/first.js";
import { Low } from "./low.js";
import { place } from "./place.js";
import { join as joined } from "node:path";
import {
  count,
  seen as before,
  shared,
} from "./server/calls.js";

const found = [new Low().low, begun, shared(), joined("a", "b"), place, ...before];
for await (const late of count()) found.push(late);
console.log(found.join(" "));
""",
}


def _written(folder: Path, modules: dict[str, str]) -> Path:
    for name, text in modules.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return folder


def _output(script: Path) -> str:
    return subprocess.run(["node", str(script)], capture_output=True, text=True, check=True).stdout.strip()


def test_joined_modules_do_the_same(tmp_path: Path) -> None:
    modules = _written(tmp_path / "js", MODULES)
    (tmp_path / "package.json").write_text('{"type": "module"}')
    for name, content in joined_scripts(modules).items():
        (tmp_path / name).write_bytes(content)
    assert _output(tmp_path / "main.js") == _output(modules / "main.js") == "1 server 3 a/b vendor calls 1 js/late.js"


def test_a_module_takes_the_place_of_another_for_all_but_itself(tmp_path: Path) -> None:
    modules = _written(tmp_path / "js", MODULES)
    (tmp_path / "package.json").write_text('{"type": "module"}')
    for name, content in joined_scripts(modules, {"server/calls.js": "static/calls.js"}).items():
        (tmp_path / name).write_bytes(content)
    assert _output(tmp_path / "main.js") == "1 files 3 a/b vendor calls 1 static js/late.js"


@pytest.mark.parametrize(
    "line",
    ['import low from "./low.js";', 'import "./low.js";', "export default 1;", "export let low = 1;", "export { a };"],
)
def test_other_forms_are_refused_with_their_place(tmp_path: Path, line: str) -> None:
    modules = _written(tmp_path, {**MODULES, "place.js": line})
    with pytest.raises(
        ValueError, match=r"^js/place.js has an import or export of a form that can't be joined: "
    ) as error:
        joined_scripts(modules)
    assert str(error.value).endswith(line)


def test_modules_in_a_circle_are_refused(tmp_path: Path) -> None:
    around = {"low.js": 'import { place } from "./place.js";\n', "place.js": 'import { LOW } from "./low.js";\n'}
    with pytest.raises(ValueError, match="imports it by way of others"):
        joined_scripts(_written(tmp_path, MODULES | around))


def test_the_first_requests_wait_for_no_library(tmp_path: Path) -> None:
    first = {"server/first.js": f'import {{ join }} from "node:path";\n{MODULES["server/first.js"]}'}
    with pytest.raises(ValueError, match="the first requests would wait for node:path"):
        joined_scripts(_written(tmp_path, MODULES | first))
