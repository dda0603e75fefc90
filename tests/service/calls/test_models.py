"""The list of models, the cards, health."""

import asyncio
import json
import os
import re
from pathlib import Path

import httpx

from shapespace.page_scripts import PAGE
from shapespace.service.http.routes.page import TaggedFiles
from tests.service.bundles import write_bundle


def test_the_list_names_the_newest_version_by_number(client: httpx.Client) -> None:
    small = next(m for m in client.get("/v1/models").json()["models"] if m["name"] == "small")
    assert small["version"] == "10"
    assert small["latent_dimension"] == 3
    assert [factor["name"] for factor in small["factors"]] == ["size", "form"]


def test_the_card_holds_the_facts_of_the_manifest(client: httpx.Client, tmp_path: Path) -> None:
    card = client.get("/v1/models/small", params={"version": "2"}).json()
    facts = json.loads((write_bundle(tmp_path, "small", "2", start=True) / "manifest.json").read_text())
    for key in ("name", "version", "lower", "upper", "period", "edges", "vertices", "faces", "figures", "scale"):
        assert card[key] == facts[key], key
    assert card["versions"] == ["1", "2", "10"]
    assert client.get("/v1/models/small").json()["version"] == "10"
    for link in card["links"].values():
        assert client.get(link).status_code in {200, 405}, link


def test_health(client: httpx.Client) -> None:
    assert client.get("/v2/health/live").json() == {"live": True}
    assert client.get("/v2/health/ready").json() == {"ready": True}


def test_the_page_and_all_it_needs_come_from_here(client: httpx.Client) -> None:
    page = client.get("/").raise_for_status()
    assert page.headers["Content-Type"].startswith("text/html")
    needed = re.findall(r'(?:href|src)="([^"]+)"', page.text)
    assert len(needed) >= 4
    for address in needed:
        assert "//" not in address
        assert client.get("/" + address).status_code == 200, address
        if tag := client.get("/" + address).headers.get("ETag"):
            assert client.get("/" + address, headers={"If-None-Match": tag}).status_code == 304
    again = client.get("/", headers={"If-None-Match": page.headers["ETag"]})
    assert (again.status_code, again.content) == (304, b"")


def test_tags_of_the_page_are_those_of_its_content_whenever_its_files_were_written(tmp_path: Path) -> None:
    async def tag(k: int, content: bytes) -> str:
        folder = tmp_path / str(k)
        folder.mkdir()
        (folder / "index.html").write_bytes(content)
        os.utime(folder / "index.html", (k, k))
        transport = httpx.ASGITransport(TaggedFiles(directory=folder))
        async with httpx.AsyncClient(transport=transport, base_url="http://localhost") as client:
            return (await client.get("/index.html")).headers["ETag"]

    content = (PAGE / "index.html").read_bytes()
    one, other, changed = (asyncio.run(tag(k, c)) for k, c in enumerate((content, content, content[:-1])))
    assert one == other != changed
