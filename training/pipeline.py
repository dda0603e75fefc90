"""A run from its first stage to its last; only stages whose input has changed are done again."""

from __future__ import annotations

import hashlib
import json
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from shapespace.arrays import FloatArray
from shapespace.bundle.geometry import Geometry
from shapespace.training.collection.generators import PRODUCTS
from shapespace.training.collection.reading import data_files
from shapespace.training.runs.config import Config
from shapespace.training.runs.directory import RunDirectory
from shapespace.training.runs.latent_coordinates import alone
from shapespace.training.runs.progress import waiting
from shapespace.training.runs.sampling import (
    DERIVATIVES,
    FEWEST,
    KNOWN,
    Collection,
    SamplesError,
    draw,
    indices,
    read,
    split,
    used,
)
from shapespace.training.runs.shortfalls import refuse, shortfalls
from shapespace.training.runs.stages import STAGES, stage_keys
from shapespace.training.space import stages as space

# PyTorch and Matplotlib, which take more than a second to load, are loaded where a stage needs them.
if TYPE_CHECKING:
    from shapespace.training.learning.learner import Learner


class OldRunError(ValueError):
    """A run of version 0.1, which can't be continued."""


def refuse_old(directory: RunDirectory) -> None:
    """Leave a run of version 0.1 as it is: what its files and settings mean today is not known.

    Raises:
        OldRunError: it is one.
    """
    if directory.is_of_0_1():
        raise OldRunError(
            f"{directory.folder} is a run of version 0.1: status and report still read it, but it can't be continued "
            "or exported; run its configuration again with another directory as --out"
        )


class Run:
    """A run: its configuration, its directory, and what it needs from outside.

    Args:
        folder: the run directory.
        config: of the run.
        source: its text.
        models: where bundles go.
        scheduler: see workers.run.
        accepted: see space.stages.ingest.
    """

    def __init__(
        self,
        folder: Path,
        config: Config,
        source: str,
        models: Path,
        scheduler: str | None = None,
        accepted: Sequence[str] = (),
    ) -> None:
        self.directory, self.config, self.models, self.scheduler = RunDirectory(folder), config, models, scheduler
        self.accepted, self.source = accepted, source

    @property
    def by_design(self) -> bool:
        """Whether the collection is a product as its generator gives it."""
        return self.config.collection.generator in PRODUCTS

    @cached_property
    def collection(self) -> Collection:
        """The parametrised collection; of meshes, once their factors are known."""
        generator = self.config.collection.generator
        if generator in PRODUCTS:
            return PRODUCTS[generator]()
        return space.collection(self.directory, self.config)

    @property
    def bundle(self) -> Path:
        """Where the bundle goes."""
        return self.models / self.config.export.name / str(self.config.export.version)

    def data(self) -> dict[str, dict[str, Any]]:
        """Size, time and SHA-256 of each file of the collection, by name; of a generator's none.

        A file is read again only where its size or its time isn't that of ``data.json``.
        """
        source = self.config.collection.data
        known, found = self.directory.data.read_if_written(), {}
        for path in data_files(source) if source else ():
            stat = path.stat()
            facts = {"bytes": stat.st_size, "time": stat.st_mtime_ns}
            before = known.get(path.name, {})
            if any(before.get(name) != value for name, value in facts.items()):
                with path.open("rb") as file:
                    before = {"sha256": hashlib.file_digest(file, "sha256").hexdigest()}
            found[path.name] = {**facts, "sha256": before["sha256"]}
        return found


def ingest(run: Run) -> None:
    """reference.npz, and of a folder of meshes shapes.npz."""
    if run.by_design:
        space.write_reference(run.directory, run.collection.reference, run.collection.scale)
    else:
        run.directory.log("ingested", **space.ingest(run.directory, run.config, run.accepted))


def _discover(run: Run, find: Callable[[RunDirectory, Config], dict[str, Any]]) -> None:
    if run.by_design:
        run.directory.log("skipped", why="the generator gives factors and bounds itself")
    else:
        run.directory.log("found", **find(run.directory, run.config))


def mean(run: Run) -> None:
    """mean.npz."""
    _discover(run, space.mean)


def modes(run: Run) -> None:
    """modes-by-strength.npz, modes.json, and modes.npz, which `factors` puts in its order."""
    _discover(run, space.modes)


def factors(run: Run) -> None:
    """factors.json and modes.npz; of a product by design factors.json, as the generator says."""
    if run.by_design:
        given = run.collection.factors
        run.directory.factors.write({"factors": list(given.values()), "names": list(given)})
    else:
        _discover(run, space.factors)


def _draw(
    run: Run, folder: Path, latents: FloatArray, title: str, *, shorten: bool, collection: Collection | None = None
) -> None:
    collection, size = collection or run.collection, run.config.samples.part_size
    parts = draw(collection, folder, latents, size, title, shorten=shorten, scheduler=run.scheduler)
    for done, total, failed in parts:
        run.directory.log("progress", what=title, done=done, total=total, failed=failed)


def samples(run: Run) -> None:
    """samples/: joint codes with their shapes, each factor's own, and the split."""
    settings, coordinates = run.config.samples, run.collection.coordinates
    directory, folder = run.directory, run.directory.samples
    code_rng, split_rng = (np.random.default_rng(s) for s in np.random.SeedSequence(settings.seed).spawn(2))
    own = settings.own(len(run.collection.factors))
    codes = coordinates.uniform(max(settings.count, *own), code_rng)
    _draw(run, folder, codes[: settings.count], "joint samples", shorten=True)
    known = run.collection.codes
    if wanted := min(len(known), settings.count // 4) * settings.shapes:
        some = np.linspace(0, len(known) - 1, wanted).round().astype(int)
        _draw(run, folder / KNOWN, known[some], "samples at the collection's shapes", shorten=True)
    else:
        shutil.rmtree(folder / KNOWN, ignore_errors=True)
    codes = used(folder, codes)
    for j, (index, count) in enumerate(zip(run.collection.factors.values(), own, strict=True)):
        _draw(run, directory.factor_samples(j), alone(codes[:count], index), f"samples of factor {j}", shorten=True)
    rows = split(indices(folder), settings.test_fraction, settings.validation_fraction, split_rng)
    directory.split.write(**rows)
    differentiated, some = run.collection.differentiated, rows["train"][: settings.differentiated]
    if differentiated and len(some):
        place = folder / DERIVATIVES
        _draw(run, place, codes[some], "derivatives", shorten=False, collection=differentiated)
    else:
        shutil.rmtree(folder / DERIVATIVES, ignore_errors=True)


def learner_of(run: Run) -> Learner:
    """The networks of a run whose samples are there."""
    from shapespace.training.learning.learner import Learner

    samples = run.directory.stamp("samples").read()["key"]
    return Learner(run.collection, run.config, run.directory, f"{samples}, {STAGES['networks'].version}")


def networks(run: Run) -> None:
    """networks/: one file for each fitted network, none of networks that are not needed any more, and all histories.

    Raises:
        SamplesError: too few to learn from.
    """
    directory = run.directory
    kinds = {"joint samples": directory.samples}
    kinds |= {
        f"samples of factor {name!r}": directory.factor_samples(j) for j, name in enumerate(run.collection.factors)
    }
    for kind, path in kinds.items():
        if (found := len(indices(path))) < FEWEST:
            raise SamplesError(f"there are only {found} {kind}, and {FEWEST} are needed to learn from")
    learner = learner_of(run)
    learner.main()
    learner.monolithic()
    learner.monolithic_paper()
    if run.config.networks.paper:
        learner.paper()
    directory.histories.write(learner.histories)
    for path in directory.networks():
        if path.stem not in learner.histories:
            path.unlink()


def generalisation(run: Run) -> None:
    """generalisation.json and least-general.npz."""
    _discover(run, space.generalisation)


def evaluation(run: Run) -> None:
    """evaluation.json and gallery.npz."""
    from shapespace.training.learning.evaluation import evaluate

    def exact(name: str, latents: FloatArray, collection: Collection | None = None) -> NDArray[np.float32]:
        folder = run.directory.exact / name
        _draw(run, folder, latents, f"exact shapes, {name}", shorten=False, collection=collection)
        samples = read(folder)
        result = np.full((len(latents), samples.nric.shape[1]), np.nan, dtype=np.float32)
        result[samples.index] = samples.nric
        return result

    figures, gallery = evaluate(learner_of(run), exact)
    if run.directory.ingest.exists():
        figures["prolongation"] = run.directory.ingest.read().get("prolongation")
    unseen = run.directory.generalisation.read_if_written()
    if unseen and "failed" not in unseen:
        figures["generalisation"] = unseen
    if not run.by_design:
        figures |= space.compactness_and_specificity(run.directory)
    run.directory.gallery.write(**gallery)
    run.directory.evaluation.write(figures)


def write_bundle_of(run: Run, figures: dict[str, Any]) -> Path:
    """The bundle of a run whose samples are there, in the models directory, with what was measured."""
    from shapespace.training.learning.examples import ExampleCorrectedCombiner
    from shapespace.training.learning.export import export

    directory = run.directory
    digest = hashlib.sha256()
    for path in sorted(directory.samples.rglob("*.npz")):
        digest.update(path.read_bytes())
    learner = learner_of(run)
    geometry = Geometry(reference=run.collection.reference) if run.by_design else space.geometry(directory)
    composite = learner.main()
    if run.config.export.examples and not run.by_design:
        composite = replace(composite, combiner=ExampleCorrectedCombiner.of(composite, *space.examples(directory)))
    with waiting("bundle"):
        return export(
            composite,
            run.collection,
            run.config,
            figures,
            digest.hexdigest(),
            run.models,
            geometry,
            learner.start(),
        )


def export_bundle(run: Run) -> None:
    """The bundle, and how near its codes come to the collection's shapes."""
    folder = write_bundle_of(run, run.directory.evaluation.read())
    run.directory.log("exported", bundle=f"{folder.parent.name}/{folder.name}")
    if not run.by_design:
        run.directory.log("encoded", **space.encoded(run.directory, run.config, folder))


#: The function of each stage. It continues from what an interrupted call has left.
_DO: dict[str, Callable[[Run], None]] = {
    "ingest": ingest,
    "mean": mean,
    "modes": modes,
    "factors": factors,
    "samples": samples,
    "networks": networks,
    "generalisation": generalisation,
    "evaluation": evaluation,
    "export": export_bundle,
}


def _changes(before: dict[str, dict[str, Any]], now: dict[str, dict[str, Any]]) -> str:
    """Which data files are new, gone or others, in words."""

    def some(word: str, names: set[str]) -> str:
        more = ", …" if len(names) > 3 else ""
        return f"{len(names)} {word} ({', '.join(sorted(names)[:3])}{more})" if names else ""

    changed = {name for name in before.keys() & now.keys() if before[name]["sha256"] != now[name]["sha256"]}
    kinds = {"added": now.keys() - before.keys(), "removed": before.keys() - now.keys(), "changed": changed}
    return ", ".join(filter(None, (some(word, set(names)) for word, names in kinds.items())))


def _forget(directory: RunDirectory, keys: dict[str, dict[str, str]], show: Callable[[str], None]) -> None:
    """Have no stage done, and no file of it there, that is not of these keys: all that a run shows belongs together."""
    outdated = []
    for name, stage in STAGES.items():
        stamp = directory.stamp(name).read_if_written()
        if stamp.get("key") == keys[name]["key"]:
            continue
        if "key" in stamp:
            if stamp.get("version") != stage.version:
                outdated.append(name)
            directory.stamp(name).write({of: stamp[of] for of in ("basis", "version") if of in stamp})
        for path in stage.results(directory):
            if not path.is_dir():
                path.unlink(missing_ok=True)
    for name in outdated[:1]:
        show(f"{name}: another version of shapespace computed it otherwise; it and all that follows is done again")


def execute(
    run: Run,
    until: str | None = None,
    *,
    keep_going: bool = False,
    command: str = "",
    show: Callable[[str], None] = print,
) -> None:
    """Do the stages that are not done yet, up to and including ``until``; in the end, report.html.

    Args:
        run: what to do.
        until: last stage.
        keep_going: whatever is lost.
        command: that goes on with this run, for messages.
        show: gets a line at a time.

    Raises:
        LostTooMuchError: more than a quarter of the logarithms or samples are lost, and no ``keep_going``.
    """
    directory, source = run.directory, run.config.collection.data
    data, known = run.data(), directory.data.read_if_written()
    if data:  # else a generator has them, and a run of 0.1 is done again
        refuse_old(directory)
    if source and known and not source.exists():
        show(f"data: {source} is not there any more; the run goes on with what ingest left")
        data = known
    elif known and (changes := _changes(known, data)):
        show(f"data: {changes}; all that follows from them is done again, from ingest on")
    keys = stage_keys(run.config, json.dumps({name: facts["sha256"] for name, facts in data.items()}) if data else "")
    _forget(directory, keys, show)
    directory.config.write(run.source)
    order = list(STAGES)
    if until is None or order.index(until) >= order.index("networks"):
        # First: loaded after the libraries that solve other stages' equations, its results differ in the last bits.
        import_module("torch")
    news = False
    for name, stage in STAGES.items():
        stamp = directory.stamp(name).read_if_written()
        if "seconds" in stamp:
            show(f"{name}: done before ({stamp['seconds']:.0f} s)")
        else:
            if stamp.get("basis") != keys[name]["basis"]:
                for path in filter(Path.is_dir, stage.results(directory)):
                    shutil.rmtree(path)
            begun = keys[name] | {"version": stage.version}
            directory.stamp(name).write(begun)
            directory.log("begin", stage=name)
            show(f"{name} …")
            start = time.monotonic()
            _DO[name](run)
            seconds = time.monotonic() - start
            directory.stamp(name).write(begun | {"seconds": seconds})
            directory.log("end", stage=name, seconds=round(seconds, 3))
            show(f"{name}: {seconds:.0f} s")
            news = True
        if name == "ingest" and data != known:
            directory.data.write(data)
        lost = shortfalls(directory, name)
        for shortfall in lost:
            show(f"  {shortfall.sentence}")
        if not keep_going:
            refuse(name, lost, f"{command} --keep-going" if command else "")
        if name == until:
            break
    if directory.evaluation.exists() and (news or not directory.report.exists()):
        from shapespace.training.report.page import write_report

        show(f"report: {write_report(directory)}")
