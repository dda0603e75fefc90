"""Kubernetes, Compose, Dockerfile and requirements: settings that exist, and pinned versions only."""

import json
import os
import re
import subprocess
import sys
import tomllib
from importlib import metadata, util
from pathlib import Path
from typing import Any

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

from shapespace.service.http.openapi import TARGET
from shapespace.service.settings import PREFIX, Settings
from tests.service.bundles import write_bundle
from tests.service.conftest import ROOT
from tests.service.watching import ENDING

NAMES = {(PREFIX + name).upper() for name in Settings.model_fields}
DIGEST = re.compile(r"[a-z0-9./-]+:[\w.-]+@sha256:[0-9a-f]{64}")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
EXTRAS = PROJECT["project"]["optional-dependencies"]
#: Extras in each locked file. Torch is not locked: its builds, and so their hashes, differ between indexes.
LOCKED = {
    "serve": {"serve", "serve-without-mkl"},
    "serve-without-mkl": {"serve-without-mkl"},
    "dev": EXTRAS.keys(),
    "lowest": {"serve", "serve-without-mkl", "client", "usd", "vtk", "check", "dev"},
}
#: Solves with MKL in both precisions, and prints the results and the names of the libraries that are loaded.
SOLVE = r"""
import re
import numpy as np
from shapespace.solve import cholesky

n, rng = 400, np.random.default_rng(0)
pattern = cholesky.SymmetricPattern(n, *rng.integers(n, size=(2, 4000)))
for precision in (np.float32, np.float64):
    entries = rng.standard_normal(len(pattern))
    entries[pattern.diagonal] = n
    factor = cholesky.analyse(pattern, "pardiso", precision=precision).factorise(entries)
    print(factor.solve(np.ones(n)).tobytes().hex())
print(*set(re.findall(r"lib(?:mkl|iomp|tbb)[^/\s]*", open("/proc/self/maps").read())))
"""
#: Torch's builds differ between indexes; `anny` brings a runtime of 400 MB, and only `make long people` installs it.
UNLOCKED = {"torch", "anny", PROJECT["project"]["name"]}


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
    ports = {port["name"]: port["containerPort"] for port in container["ports"]}
    annotations = kinds["Deployment"]["spec"]["template"]["metadata"]["annotations"]
    assert str(ports["metrics"]) == environment["SHAPESPACE_METRICS_PORT"] == annotations["prometheus.io/port"]
    assert {port["targetPort"] for port in kinds["Service"]["spec"]["ports"]} == {"http"}
    mounts = {mount["name"]: mount["mountPath"] for mount in container["volumeMounts"]}
    volumes = {volume["name"]: volume for volume in pod["volumes"]}
    assert volumes["models"]["persistentVolumeClaim"]["claimName"] == named(kinds["PersistentVolumeClaim"])
    assert volumes["versions"]["configMap"]["name"] == named(kinds["ConfigMap"])
    assert mounts["models"] == f"{working_folder()}/models"
    (file,) = kinds["ConfigMap"]["data"]
    assert f"{mounts['versions']}/{file}" == environment["SHAPESPACE_DEFAULT_VERSIONS_FILE"]
    for probe in ("startupProbe", "readinessProbe", "livenessProbe"):
        assert container[probe]["httpGet"]["path"] in served
        assert container[probe]["httpGet"]["port"] == container["ports"][0]["name"]
    # Readiness has to change before the port closes, or requests would be lost.
    readiness = container["readinessProbe"]
    assert 1 < readiness["timeoutSeconds"] < readiness["periodSeconds"]
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
    for name in ("serve", "serve-without-mkl", "build"):
        assert all(versions <= tested[package] for package, versions in locked(name).items())


def test_no_mkl_comes_where_none_is_asked_for() -> None:
    without, extra = locked("serve").keys() - locked("serve-without-mkl").keys(), EXTRAS["serve-without-mkl"]
    assert {"mkl", "pypardiso", "intel-openmp"} <= without
    assert {requirement.name for requirement in map(Requirement, extra)} <= locked("serve-without-mkl").keys()


@pytest.mark.skipif(not util.find_spec("pypardiso"), reason="MKL has wheels for x86-64 only")
def test_what_the_image_leaves_out_is_never_loaded(tmp_path: Path) -> None:
    """Solve in a copy of MKL's wheels after the script of the Dockerfile, and compare with the whole wheels."""
    assert "python scripts/slim.py /opt/shapespace" in (ROOT / "Dockerfile").read_text()
    packages = tmp_path / "lib" / f"python3.{sys.version_info.minor}" / "site-packages"
    for wheel in ("mkl", "intel-openmp", "tbb", "numpy"):
        for file in metadata.files(wheel) or ():
            whole, copy = Path(str(file.locate())), Path(os.path.normpath(packages / file))
            wanted = wheel != "numpy" or "tests" in file.parts or file.parts[0].endswith(".dist-info")
            if wanted and whole.exists() and copy.is_relative_to(tmp_path):
                copy.parent.mkdir(parents=True, exist_ok=True)
                copy.symlink_to(whole.resolve())
    before = {path.name for path in (tmp_path / "lib").glob("lib*")}
    script = [sys.executable, str(ROOT / "scripts" / "slim.py"), str(tmp_path)]
    subprocess.run(script, check=True)
    subprocess.run(script, check=True)  # a second run finds nothing
    after = {path.name for path in (tmp_path / "lib").glob("lib*")}
    kernels = {name for name in before if re.match(r"libmkl_(vml_)?(def|mc|avx)", name)}
    assert len(kernels) > 4
    assert kernels <= after
    assert not (packages / "numpy").exists()
    gone = {name for name in before - after if ".so" in name}
    assert {"libmkl_intel_thread", "libmkl_tbb_thread", "libiomp5"} <= {name.partition(".")[0] for name in gone}
    solve = [sys.executable, "-c", SOLVE]
    found = [
        subprocess.run(
            solve,
            env=os.environ | {"PYTHONPATH": os.pathsep.join(path)},
            cwd=ROOT,
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for path in ([str(ROOT)], [str(packages), str(ROOT)])
    ]
    assert found[0].splitlines()[:2] == found[1].splitlines()[:2]
    loaded = set(found[0].splitlines()[-1].split())
    assert {"libmkl_core", "libmkl_sequential"} <= {name.partition(".")[0] for name in loaded}
    assert loaded <= after


def test_an_empty_volume_gets_the_models_of_the_image(tmp_path: Path) -> None:
    (first,) = manifests()["Deployment"]["spec"]["template"]["spec"]["initContainers"]
    source, volume = tmp_path / "image" / "models", tmp_path / "volume"
    write_bundle(source, "small", "1")
    volume.mkdir()
    *shell, script = first["command"]
    script = script.replace(f"{working_folder()}/models", str(source)).replace("/models/", f"{volume}/")
    script = script.replace(f"{source.parent}{volume}/", f"{source}/").replace("ls /models", f"ls {volume}")
    for _ in range(2):
        subprocess.run([*shell, script], check=True, env=os.environ | {"HOSTNAME": "pod-1"})
        assert [str(path.relative_to(volume)) for path in sorted(volume.glob("*/*"))] == ["small/1"]
        assert len(list(volume.iterdir())) == 1
        write_bundle(source, "later", "1")  # it does not come by itself


def named(document: Any) -> str:
    return str(document["metadata"]["name"])


def working_folder() -> str:
    lines = (ROOT / "Dockerfile").read_text().splitlines()
    return [line.split()[1] for line in lines if line.startswith("WORKDIR ")][-1]


def user() -> str:
    line = next(line for line in (ROOT / "Dockerfile").read_text().splitlines() if line.startswith("USER "))
    return line.split()[1].split(":")[0]
