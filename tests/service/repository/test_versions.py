"""Default versions: shares of the codes, the same in every call and process, and a file that reloads read again."""

import json
import re
import signal
from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest

from shapespace.service.repository.repository import ModelRepository
from shapespace.service.versions import FILE_NAME, DefaultVersions, DefaultVersionsError
from tests.service.bundles import SCALE, rescale, write_bundle
from tests.service.conftest import Server, starting
from tests.service.watching import eventually, samples, value

CODES = [[round(0.01 * k, 2), 0.7, 0.4] for k in range(16)]
SHARES = "small = 1:60, 2:40  # a canary\n"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("versions") / "models"
    write_bundle(folder, "small", "1")
    rescale(write_bundle(folder, "small", "2"), 2 * SCALE)
    return folder


@pytest.fixture(scope="module")
def served(folder: Path) -> Iterator[Server]:
    with starting() as start:
        yield start(folder, workers=2)


@pytest.fixture
def client(folder: Path, served: Server) -> Iterator[httpx.Client]:
    """A client of a server that divides codes between two versions."""
    roll_out(folder, served, SHARES)
    with httpx.Client(base_url=served.url, timeout=60) as client:
        yield client


def roll_out(folder: Path, server: Server, text: str) -> None:
    """Replace the file with default versions, and reload."""
    (folder / FILE_NAME).write_text(text)
    before = server.log.count("reloaded:")
    server.process.send_signal(signal.SIGHUP)
    eventually(lambda: server.log.count("reloaded:") > before)


def version(answer: httpx.Response) -> str:
    return answer.raise_for_status().headers["Model-Version"]


def versions(client: httpx.Client) -> list[str]:
    """The version that answers each of CODES."""
    return [version(client.get("/v1/models/small/mesh", params={"latent": comma(code)})) for code in CODES]


def comma(code: list[float]) -> str:
    return ",".join(map(str, code))


def test_a_code_has_the_same_version_in_every_call(client: httpx.Client) -> None:
    found = versions(client)
    assert {"1", "2"} == set(found)
    for code, expected in zip(CODES, found, strict=True):
        others = [code, *CODES]
        nested = {"name": "latent", "shape": [17, 3], "datatype": "FP32", "data": others}
        flat = nested | {"data": [number for code in others for number in code]}
        bodies = {
            "/v1/models/small/mesh": {"latent": code},
            "/v1/models/small/vertices": {"latents": others},
            "/v1/models/small/nric": {"latents": others},
            "/v1/models/small/interpolations": {"keyframes": others},
            "/v1/models/small/edit": {"latent": code, "targets": [{"vertex": 0, "position": [0, 0, 0]}]},
        }
        for path, body in bodies.items():
            assert version(client.post(path, json=body)) == expected, path
        for tensor in (nested, flat):
            answer = client.post("/v2/models/small/infer", json={"inputs": [tensor]})
            assert version(answer) == answer.json()["model_version"] == expected
        message = json.dumps({"inputs": [nested | {"data": None, "parameters": {"binary_data_size": 204}}]}).encode()
        tail = np.array(others, "<f4").tobytes()
        headers = {"Inference-Header-Content-Length": str(len(message))}
        assert version(client.post("/v2/models/small/infer", content=message + tail, headers=headers)) == expected


def test_another_process_divides_codes_alike(client: httpx.Client, small_models: Path, folder: Path) -> None:
    with starting() as start:
        # The variable wins over the file, which names the same model.
        other = start(folder, default_versions="small=2:40,1:60", default_versions_file=folder / FILE_NAME)
        with httpx.Client(base_url=other.url, timeout=60) as second:
            assert versions(second) == versions(client)


def test_answers_say_which_version_they_are_of(client: httpx.Client) -> None:
    path = "/v1/models/small/mesh"
    for code in CODES[:4]:
        answer = client.get(path, params={"latent": comma(code), "format": "obj"})
        again = client.get(answer.headers["Content-Location"])
        assert again.request.url.params["version"] == version(answer) == version(again)
        assert (again.content, again.headers["ETag"]) == (answer.content, answer.headers["ETag"])
        assert "Content-Location" not in again.headers
        (other,) = {"1", "2"} - {version(answer)}
        explicit = client.post(path, json={"latent": code}, params={"version": other, "format": "obj"})
        assert version(explicit) == other
        assert explicit.headers["ETag"] != answer.headers["ETag"]
        unchanged = client.get(str(answer.request.url), headers={"If-None-Match": answer.headers["ETag"]})
        assert unchanged.status_code == 304
        assert unchanged.headers["Model-Version"] == version(answer)
    frames = client.post("/v1/models/small/interpolations", json={"keyframes": CODES[:2]})
    assert version(client.get(frames.json()["links"]["frames"].replace("{k}", "0"))) == version(frames)


def test_requests_without_a_code_get_the_larger_share_and_files_one_version_each(client: httpx.Client) -> None:
    assert [model["version"] for model in client.get("/v1/models").json()["models"]] == ["1"]
    assert client.get("/v1/models/small").json()["version"] == "1"
    assert version(client.get("/v1/models/small/mesh")) == "1"
    found = set()
    for k in range(12):
        mesh = client.get("/v1/models/small/mesh", params={"latent": comma(CODES[k]), "format": "obj", "version": 1})
        asked = [client.post("/v1/models/small/encode", params={"format": "obj"}, content=mesh.content) for _ in "ab"]
        assert len({version(answer) for answer in asked}) == 1
        found.add(version(asked[0]))
    assert found == {"1", "2"}
    for content, status in ((b"{", 400), (b'{"latent": "x"}', 422), (b'{"latent": [1, [2], 3]}', 422)):
        headers = {"Content-Type": "application/json"}
        assert client.post("/v1/models/small/mesh", content=content, headers=headers).status_code == status


def test_a_reload_rolls_out_and_back_and_names_faults(client: httpx.Client, folder: Path, served: Server) -> None:
    roll_out(folder, served, "small=2")
    assert set(versions(client)) == {"2"}
    roll_out(folder, served, "small=1")
    assert set(versions(client)) == {"1"}
    assert client.get("/v2/health/ready").json() == {"ready": True}
    assert value(samples(client), "shapespace_default_version_faults") == 0
    for text, chosen, fault in (
        ("small=7", "2", "name small/7, which is not served: small/2 answers"),
        ("small=1:90,7:10", "1", "name small/7, which is not served: small/1 answers"),
        ("small=1:90,2:20", "1", f"stay as they were. .*{FILE_NAME}: The shares of small add up to 110"),
        ("small=1\nlarge=3", "1", "name large/3, which is not served: add its bundle"),
    ):
        roll_out(folder, served, text)
        assert set(versions(client)) == {chosen}, text
        ready = client.get("/v2/health/ready").raise_for_status().json()
        assert ready["ready"] is True
        assert any(re.search(fault, told) for told in ready["faults"]), ready
        assert all(told in served.log for told in ready["faults"])
        assert value(samples(client), "shapespace_default_version_faults") >= 1


def test_a_changed_file_is_noticed(folder: Path, tmp_path: Path) -> None:
    file = tmp_path / "versions"
    repository = ModelRepository(tmp_path, file=file)
    assert repository.signature() == repository.seen
    file.write_text("small=1")
    assert repository.signature() != repository.seen


def test_a_larger_share_moves_codes_to_the_new_version_alone() -> None:
    keys = [str(k).encode() for k in range(4000)]
    before, after = (DefaultVersions.parse(f"figure={text}") for text in ("3:95,4:5", "4:20,3:80"))
    chosen = [(before.choose("figure", [3, 4], key), after.choose("figure", [3, 4], key)) for key in keys]
    assert 0.04 < np.mean([first == 4 for first, _ in chosen]) < 0.06
    assert 0.18 < np.mean([second == 4 for _, second in chosen]) < 0.22
    assert (4, 3) not in chosen


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("3", "has no name"),
        ("figure", "has no name"),
        ("Figure=3", "is not the name"),
        ("figure=", "names no version"),
        ("figure=new", "names no version"),
        ("figure=03", "names no version"),
        ("figure=3,4", "add up to 200 per cent"),
        ("figure=3:95,4", "add up to 195 per cent"),
        ("figure=3:95,4:much", "names no share"),
        ("figure=3:95,4:-5", "names no share"),
        ("figure=3:nan,4:5", "names no share"),
        ("figure=3:95,4:6", "add up to 101 per cent"),
        ("figure=3:95", "add up to 95 per cent"),
        ("figure=3:50,3:50", "names version 3 twice"),
        ("figure=3,figure=4", "named twice"),
    ],
)
def test_what_is_no_list_of_versions_is_named(text: str, fault: str) -> None:
    with pytest.raises(DefaultVersionsError, match=fault):
        DefaultVersions.parse(text)
