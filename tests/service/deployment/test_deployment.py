"""Kubernetes, Compose, Dockerfile and requirements: settings that exist, and pinned versions only."""

import json
import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

from shapespace.service.http.openapi import TARGET
from shapespace.service.settings import PREFIX, Settings
from tests.service.conftest import ROOT
from tests.service.watching import ENDING

NAMES = {(PREFIX + name).upper() for name in Settings.model_fields}
DIGEST = re.compile(r"[a-z0-9./-]+:[\w.-]+@sha256:[0-9a-f]{64}")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
EXTRAS = PROJECT["project"]["optional-dependencies"]
#: Extras in each locked file. Torch is not locked: its builds, and so their hashes, differ between indexes.
LOCKED = {"serve": {"serve"}, "dev": EXTRAS.keys(), "lowest": {"serve", "client", "usd", "check", "dev"}}
UNLOCKED = {"torch", PROJECT["project"]["name"]}


def manifests() -> dict[str, Any]:
    documents = yaml.safe_load_all((ROOT / "deploy" / "kubernetes.yaml").read_text())
    return {document["kind"]: document for document in documents}


def test_the_kubernetes_manifest_fits_the_server() -> None:
    kinds = manifests()
    pod = kinds["Deployment"]["spec"]["template"]["spec"]
    (container,) = pod["containers"]
    environment = {entry["name"]: entry.get("value") for entry in container["env"]}
    assert environment.keys() <= NAMES
    assert pod["terminationGracePeriodSeconds"] > float(environment["SHAPESPACE_DRAIN"]) + ENDING
    served = json.loads(TARGET.read_text())["paths"]
    for probe in ("startupProbe", "readinessProbe", "livenessProbe"):
        assert container[probe]["httpGet"]["path"] in served
        assert container[probe]["httpGet"]["port"] == container["ports"][0]["name"]
    # Readiness has to change before the port closes, or requests would be lost.
    readiness = container["readinessProbe"]
    assert readiness["periodSeconds"] * readiness["failureThreshold"] < float(environment["SHAPESPACE_DRAIN"])
    assert container["resources"]["limits"].keys() == {"cpu", "memory"}
    assert container["securityContext"]["readOnlyRootFilesystem"]
    assert pod["securityContext"]["runAsUser"] == int(user())
    labels = kinds["Deployment"]["spec"]["template"]["metadata"]["labels"]
    for selector in (
        kinds["Deployment"]["spec"]["selector"]["matchLabels"],
        kinds["PodDisruptionBudget"]["spec"]["selector"]["matchLabels"],
        kinds["Service"]["spec"]["selector"],
    ):
        assert selector == labels
    scaler = kinds["HorizontalPodAutoscaler"]["spec"]
    assert scaler["scaleTargetRef"]["name"] == kinds["Deployment"]["metadata"]["name"]
    assert 2 <= scaler["minReplicas"] < scaler["maxReplicas"]


def test_kubernetes_starts_nothing_without_its_key() -> None:
    (container,) = manifests()["Deployment"]["spec"]["template"]["spec"]["containers"]
    (key,) = (entry for entry in container["env"] if entry["name"] == "SHAPESPACE_API_KEY")
    assert not key["valueFrom"]["secretKeyRef"].get("optional")


def test_the_compose_file_fits_the_server() -> None:
    services = yaml.safe_load((ROOT / "compose.yaml").read_text())["services"]
    server = services["shapespace"]
    assert server["environment"].keys() <= NAMES
    grace = float(server["stop_grace_period"].removesuffix("s"))
    assert grace > float(server["environment"]["SHAPESPACE_DRAIN"]) + ENDING
    assert server["deploy"]["replicas"] >= 2
    for service in services.values():
        for volume in service.get("volumes", []):
            assert Path(ROOT, volume.split(":")[0]).exists(), volume


def test_images_of_others_are_named_by_their_digest() -> None:
    lines = (ROOT / "Dockerfile").read_text().splitlines()
    stages = {line.split()[-1] for line in lines if line.startswith("FROM ") and " AS " in line}
    bases = {line.split()[1] for line in lines if line.startswith("FROM ")} - stages
    services = yaml.safe_load((ROOT / "compose.yaml").read_text())["services"].values()
    named = [*bases, *(service["image"] for service in services if "build" not in service)]
    assert len(named) == 2
    for image in named:
        assert DIGEST.fullmatch(image), image


def locked(name: str) -> dict[str, set[Version]]:
    """Versions by package in a file of ``requirements/``; asserts that it has only these and hashes."""
    found: dict[str, set[Version]] = {}
    for line in (ROOT / "requirements" / f"{name}.txt").read_text().replace("\\\n", " ").splitlines():
        if line.startswith("#"):
            continue
        package, *hashes = re.split(r"\s+--hash=", line)
        assert hashes
        assert all(re.fullmatch("sha256:[0-9a-f]{64}", hash) for hash in hashes)
        requirement = Requirement(package)
        assert requirement.url is None
        (pin,) = requirement.specifier
        assert pin.operator == "=="
        found.setdefault(canonicalize_name(requirement.name), set()).add(Version(pin.version))
    return found


def declared(extras: Any) -> list[Requirement]:
    lines = [*PROJECT["project"]["dependencies"], *(line for extra in extras for line in EXTRAS[extra])]
    return [requirement for requirement in map(Requirement, lines) if requirement.name not in UNLOCKED]


@pytest.mark.parametrize("name", LOCKED)
def test_every_dependency_is_locked_in_its_range(name: str) -> None:
    versions = locked(name)
    for requirement in declared(LOCKED[name]):
        assert all(map(requirement.specifier.contains, versions[canonicalize_name(requirement.name)])), requirement


def test_the_lowest_versions_are_those_that_are_tried() -> None:
    versions = locked("lowest")
    for requirement in declared(LOCKED["lowest"]):
        (least,) = requirement.specifier
        assert min(versions[canonicalize_name(requirement.name)]) == Version(least.version), requirement


def test_the_image_has_what_is_tested() -> None:
    tested = locked("dev")
    for name in ("serve", "build"):
        assert all(versions <= tested[package] for package, versions in locked(name).items())


def user() -> str:
    line = next(line for line in (ROOT / "Dockerfile").read_text().splitlines() if line.startswith("USER "))
    return line.split()[1].split(":")[0]
