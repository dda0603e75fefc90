"""The compose file and the Kubernetes manifest say nothing that the server doesn't know."""

import json
from pathlib import Path
from typing import Any

import yaml

from service.openapi import TARGET
from service.settings import PREFIX, Settings
from tests.service.conftest import ROOT

NAMES = {(PREFIX + name).upper() for name in Settings.model_fields}
DEADLINE = Settings.model_fields["deadline"].default


def manifests() -> dict[str, Any]:
    documents = yaml.safe_load_all((ROOT / "deploy" / "kubernetes.yaml").read_text())
    return {document["kind"]: document for document in documents}


def test_the_kubernetes_manifest_fits_the_server() -> None:
    kinds = manifests()
    pod = kinds["Deployment"]["spec"]["template"]["spec"]
    (container,) = pod["containers"]
    environment = {entry["name"]: entry.get("value") for entry in container["env"]}
    assert environment.keys() <= NAMES
    assert pod["terminationGracePeriodSeconds"] > float(environment["SHAPESPACE_DRAIN"]) + DEADLINE + 1
    served = json.loads(TARGET.read_text())["paths"]
    for probe in ("startupProbe", "readinessProbe", "livenessProbe"):
        assert container[probe]["httpGet"]["path"] in served
        assert container[probe]["httpGet"]["port"] == container["ports"][0]["name"]
    # Readiness turns before the port closes, or traffic would be lost.
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


def test_the_compose_file_fits_the_server() -> None:
    services = yaml.safe_load((ROOT / "compose.yaml").read_text())["services"]
    server = services["shapespace"]
    assert server["environment"].keys() <= NAMES
    grace = float(server["stop_grace_period"].removesuffix("s"))
    assert grace > float(server["environment"]["SHAPESPACE_DRAIN"]) + DEADLINE + 1
    assert server["deploy"]["replicas"] >= 2
    for service in services.values():
        for volume in service.get("volumes", []):
            assert Path(ROOT, volume.split(":")[0]).exists(), volume


def user() -> str:
    line = next(line for line in (ROOT / "Dockerfile").read_text().splitlines() if line.startswith("USER "))
    return line.split()[1].split(":")[0]
