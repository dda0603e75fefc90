"""``edit``, ``sample``, exact exponentials and the diagnostics of a code."""

import io
import json
from typing import Any

import httpx
import numpy as np
import pytest

from shapespace.coordinates.integrability import Integrability
from shapespace.mesh.rigid_motion import align
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.shell.energy import Material
from shapespace.shell.exponential import exponential
from shapespace.shell.space import ShellSpace
from tests.service.bundles import expected_nric, reference
from tests.service.conftest import ROOT

EDIT, SAMPLE = "/v1/models/with-fine/edit", "/v1/models/with-fine/sample"
CODE = [0.1, 0.7, 0.4]
LOWER, UPPER = np.array([-0.2, -np.pi, 0]), np.array([0.2, np.pi, 1])


def positions(
    client: httpx.Client, code: Any, model: str = "with-fine", mesh: str = "fine", quality: str = "auto"
) -> np.ndarray:
    body = {"latents": [np.asarray(code).tolist()], "mesh": mesh, "quality": quality}
    answer = client.post(f"/v1/models/{model}/vertices", json=body)
    return np.array(answer.raise_for_status().json()["vertices"][0])


def placed(found: Any, vertices: np.ndarray) -> np.ndarray:
    """Positions in the frame of the shape that an edit began with."""
    placement = found["placement"]
    assert placement["scale"] == 1
    moved: np.ndarray = vertices @ np.array(placement["rotation"]).T + placement["translation"]
    return moved


def edit(client: httpx.Client, places: np.ndarray, vertices: list[int], path: str = EDIT, **body: Any) -> Any:
    targets = [{"vertex": v, "position": p} for v, p in zip(vertices, places.tolist(), strict=True)]
    answer = client.post(path, json={"latent": CODE, "targets": targets} | body)
    assert answer.status_code == 200, answer.text
    return answer.json()


@pytest.mark.parametrize(("name", "seed"), [("figure", 1), ("figure", 2), ("freaky-torus", 1)])
def test_an_edit_reaches_what_can_be_reached(client: httpx.Client, name: str, seed: int) -> None:
    sampled = client.post(f"/v1/models/{name}/sample", json={"count": 2, "seed": seed}).json()["latents"]
    start, goal = sampled
    shape = positions(client, goal, name)
    rng = np.random.default_rng(seed)
    vertices = rng.choice(len(shape), 4, replace=False).tolist()
    found = edit(client, shape[vertices], vertices, f"/v1/models/{name}/edit", latent=start)
    reached = placed(found, positions(client, found["latent"], name, quality="full"))  # as the edit's last shape
    diagonal = np.linalg.norm(np.ptp(shape, axis=0))
    distances = np.linalg.norm(reached[vertices] - shape[vertices], axis=1)
    assert distances.max() < 0.01 * diagonal
    np.testing.assert_allclose(found["distances"], distances, atol=5e-5)
    assert found["residual"] == pytest.approx(np.sqrt((distances**2).mean()), abs=5e-5)
    card = client.get(f"/v1/models/{name}").json()
    assert (np.array(card["lower"]) <= np.array(found["latent"]) + 1e-6).all()
    assert (np.array(found["latent"]) <= np.array(card["upper"]) + 1e-6).all()
    assert found["diagnostics"]["inside_bounds"]


def test_an_edit_goes_as_far_as_it_can_towards_a_target_out_of_reach(client: httpx.Client) -> None:
    path = "/v1/models/freaky-torus"
    start, *others = client.post(f"{path}/sample", json={"count": 10, "seed": 4}).json()["latents"]
    shape = positions(client, start, "freaky-torus")
    answer = client.post(f"{path}/vertices", json={"latents": others}).raise_for_status().json()["vertices"]
    for far in (1, 100):
        place = shape[100] + far * np.linalg.norm(np.ptp(shape, axis=0)) / np.sqrt(3)
        nearest = np.linalg.norm(np.array(answer)[:, 100] - place, axis=1).min()
        assert edit(client, place[None], [100], f"{path}/edit", latent=start)["residual"] < nearest


def test_an_edit_leaves_a_valley_that_ends_above_its_targets(client: httpx.Client) -> None:
    # From this start descent ends 1.4 % from the targets, and changing a single factor does not help.
    path = "/v1/models/figure"
    start, goal = (
        client.post(f"{path}/sample", json={"count": 14, "seed": seed}).json()["latents"][13] for seed in (1, 2)
    )
    shape, vertices = positions(client, goal, "figure"), [3641, 4032, 1100]
    found = edit(client, shape[vertices], vertices, f"{path}/edit", latent=start)
    assert found["residual"] < 0.002 * np.linalg.norm(np.ptp(shape, axis=0))


def test_an_edit_stays_inside_the_bounds(client: httpx.Client) -> None:
    shape = positions(client, CODE)
    found = edit(client, 3 * shape[[5, 200]], [5, 200], latent=[5, 0.7, -3])
    latent = np.array(found["latent"])
    assert latent[0] == pytest.approx(0.2, abs=1e-6)
    assert (latent >= LOWER - 1e-6).all()
    assert (latent <= UPPER + 1e-6).all()
    assert found["residual"] > 0.5


def test_bad_edits_are_told_what_to_do(client: httpx.Client) -> None:
    target = {"vertex": 0, "position": [0, 0, 0]}
    for change, says in (
        ({"latent": [0, 0]}, "Give exactly 3"),
        ({"targets": []}, "1 or more entries for targets"),
        ({"targets": [target, target | {"vertex": 512}]}, "targets[1].vertex is 512, but the fine mesh has"),
        ({"targets": [target | {"vertex": 64}], "mesh": "coarse"}, "vertices 0 to 63"),
        ({"targets": [target | {"vertex": -1}]}, "vertex is -1"),
        ({"targets": [target | {"vertex": 0.5}]}, "whole number"),
        ({"targets": [target | {"position": [0, 0]}]}, "3 or more entries"),
        ({"targets": [target | {"position": [0, 0, 1e300]}]}, "Give finite positions"),
        ({"targets": [target | {"weight": 2}]}, "Remove 'targets[0].weight'"),
        ({"prior": -1}, "at least 0"),
        ({"prior_kind": "lasso"}, "'groups' or 'ridge'"),
        ({"targets": [target | {"sigma": 0}]}, "number above 0 for targets[0].sigma"),
        ({"fixed": {"3": 0}}, "coordinates 0 to 2"),
        ({"fixed": {"-1": 0}}, "'-1' is not an index"),
        ({"fixed": {"0": None}}, "the value at 0 is not a finite number"),
        ({"fixed": [0]}, "fixed"),
        ({"samples": 21}, "the limit is 20"),
        ({"seed": -1}, "at least 0"),
        ({"seed": 2**64}, "number below 9223372036854775808 for seed"),
    ):
        answer = client.post(EDIT, json={"latent": CODE, "targets": [target]} | change)
        assert answer.status_code == 422, answer.text
        assert says in answer.json()["detail"]


def test_samples_depend_on_their_seed_alone_and_lie_inside_the_bounds(client: httpx.Client) -> None:
    def sample(**body: Any) -> np.ndarray:
        return np.array(client.post(SAMPLE, json=body).raise_for_status().json()["latents"])

    for distribution in ("uniform", "gaussian"):
        codes = sample(count=20, seed=7, distribution=distribution)
        assert codes.shape == (20, 3)
        np.testing.assert_array_equal(codes, sample(count=20, seed=7, distribution=distribution))
        np.testing.assert_array_equal(codes[:5], sample(count=5, seed=7, distribution=distribution))
        assert not np.isin(codes, sample(count=20, seed=8, distribution=distribution)).any()
        assert (codes >= LOWER - 1e-6).all()
        assert (codes <= UPPER + 1e-6).all()
    spread = {
        kind: np.concatenate([sample(count=20, seed=s, distribution=kind) for s in range(20)]).std(axis=0)
        for kind in ("uniform", "gaussian")
    }
    # Shares of the bounds' width: 1/√12, and 0.88/4 for a Gaussian truncated at two standard deviations.
    np.testing.assert_allclose(spread["uniform"] / (UPPER - LOWER), 0.2887, rtol=0.1)
    np.testing.assert_allclose(spread["gaussian"] / (UPPER - LOWER), 0.2199, rtol=0.1)
    np.testing.assert_array_equal(sample(), sample(count=1, seed=0, distribution="uniform"))


def test_bad_samples_are_told_what_to_do(client: httpx.Client) -> None:
    for body, says in (
        ({"count": 21}, "the limit is 20"),
        ({"count": 0}, "at least 1"),
        ({"count": 2.5}, "whole number"),
        ({"seed": -1}, "at least 0"),
        ({"distribution": "cauchy"}, "'uniform', 'gaussian' or 'population'"),
        ({"distribution": "population", "temperature": -1}, "at least 0"),
        ({"distribution": "population", "temperature": 1e300}, "not a finite number"),
        ({"temperature": 2}, 'only for "distribution": "population"'),
    ):
        answer = client.post(SAMPLE, json=body)
        assert answer.status_code == 422, answer.text
        assert says in answer.json()["detail"]


def test_exact_exponentials_stand_beside_the_networks_answer(client: httpx.Client) -> None:
    codes = np.array(client.post("/v1/models/figure/sample", json={"count": 2, "seed": 1}).json()["latents"])
    vertices = "/v1/models/figure/vertices"
    body = {"latents": codes.tolist(), "mesh": "coarse", "exact": True}
    answer = client.post(vertices, json=body).raise_for_status().json()
    assert answer["exact_status"] == ["converged", "converged"]
    folder = ROOT / "models" / "figure" / "4"
    facts = json.loads((folder / "manifest.json").read_text())
    with np.load(folder / "geometry.npz") as file:
        mesh, modes = TriangleMesh.from_mapping(file), file["modes"].astype(float)
    material = Material(facts["mu"], facts["lambda"], facts["eta"])
    velocity = np.tensordot(codes[0], modes, axes=1)
    space = ShellSpace(mesh, material, first_step=facts.get("exponential_first_step", "paper"))
    path = exponential(space, mesh.vertices, velocity, facts["exponential_steps"])
    expected = facts["scale"] * align(path.vertices[-1], mesh.vertices)
    np.testing.assert_allclose(answer["exact"][0], expected, atol=1e-5)
    for found, exact, distance in zip(answer["vertices"], answer["exact"], answer["distance"], strict=True):
        away = np.linalg.norm(np.array(found) - exact, axis=1)
        assert distance["mean"] == pytest.approx(away.mean(), rel=1e-3)
        assert distance["max"] == pytest.approx(away.max(), rel=1e-3)
        assert 0 < distance["mean"] < 2e-3
    plain = {"latents": codes.tolist(), "mesh": "fine"}
    content = client.post(vertices, json=plain, params={"format": "npz", "exact": True}).raise_for_status().content
    with np.load(io.BytesIO(content)) as arrays:
        assert arrays["exact"].shape == arrays["vertices"].shape == (2, 4601, 3)
        away = np.linalg.norm(arrays["exact"] - arrays["vertices"], axis=2)
        np.testing.assert_allclose(arrays["distance_max"], away.max(axis=1), rtol=1e-3)
        assert arrays["exact_status"].tolist() == ["converged"] * 2


def test_an_exponential_that_fails_is_null(client: httpx.Client) -> None:
    body = {"latents": [[3.0] * 20, [0.0] * 20], "mesh": "coarse", "exact": True}
    answer = client.post("/v1/models/figure/vertices", json=body).raise_for_status().json()
    assert answer["exact"][0] is None
    assert answer["distance"][0] is None
    assert answer["exact_status"][0] != "converged"
    assert answer["distance"][1]["max"] < 0.01


def test_a_product_by_design_has_no_exact_exponentials(client: httpx.Client) -> None:
    for query, body in (({}, {"exact": True}), ({"exact": "true"}, {})):
        answer = client.post("/v1/models/freaky-torus/vertices", params=query, json={"latents": [[0] * 4]} | body)
        assert answer.status_code == 422
        assert answer.json()["type"].endswith("no-tangent-space")
        assert "Leave out" in answer.json()["detail"]


def test_diagnostics_tell_how_plausible_a_code_and_how_integrable_its_lengths_and_angles_are(
    client: httpx.Client,
) -> None:
    # Distances as fractions of the bounds' width, (0.4, 2π, 1); the nearest neighbours of five training codes are
    # 0.1, 0.1, 0.1, and the shorter way from 3 to −3 for two of them.
    turn = (2 * np.pi - 6) / (2 * np.pi)
    spacing = np.median([0.1, 0.1, 0.1, turn, turn]) / np.sqrt(3)
    latents = [[0, 0, 0.2], [0, 0, 0.5], CODE]
    found = client.post("/v1/models/with-fine/vertices", json={"latents": latents}).json()["diagnostics"]
    assert found[0]["plausibility"] == pytest.approx(0, abs=1e-6)
    assert found[1]["plausibility"] == pytest.approx(0.3 / np.sqrt(3) / spacing, rel=1e-4)
    mesh = reference()
    conditions = Integrability(mesh.connectivity)
    for code, diagnostics in zip(latents, found, strict=True):
        q = conditions.at_vertices(expected_nric(np.array(code)))
        assert diagnostics["integrability"] == pytest.approx(np.sqrt((q**2).sum(axis=1).mean()), rel=1e-3)
    size = client.post("/v1/models/small/mesh", json={"latent": [0.1, 0, 0]}).headers["Shape-Diagnostics"]
    assert json.loads(size)["integrability"] < 1e-5, "a uniform scaling is integrable"
    assert json.loads(size)["plausibility"] is None
