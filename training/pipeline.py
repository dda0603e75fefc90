"""The stages of a run, in order; each leaves its result in the run directory and is repeated only where it must be."""

from __future__ import annotations

import hashlib
import json
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from shapespace.arrays import FloatArray
from shapespace.training.collection.freaky_torus import FreakyTorus
from shapespace.training.collection.ingest import data_files
from shapespace.training.learning.evaluation import alone, evaluate
from shapespace.training.learning.export import export
from shapespace.training.learning.learner import Learner
from shapespace.training.report.page import write_report
from shapespace.training.runs.config import Config
from shapespace.training.runs.files import write_json, write_npz, write_text
from shapespace.training.runs.losses import losses, refuse
from shapespace.training.runs.sampling import FEWEST, Collection, SamplesError, draw, indices, read, split, used
from shapespace.training.space import discovery


class OldRunError(ValueError):
    """A run of another version that can't be continued."""


GENERATORS: dict[str, Callable[[], Collection]] = {"freaky-torus": FreakyTorus}


class Run:
    """A run directory: configuration, log, and what the stages have left in it.

    Args:
        folder: of the run.
        config: of the run.
        source: its text.
        models: where bundles go.
        scheduler: see workers.run.
        accepted: see discovery.ingest.
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
        self.folder, self.config, self.models, self.scheduler = folder, config, models, scheduler
        self.accepted = accepted
        self._source, self._stamps = source, folder / "stages"

    def begin(self) -> None:
        """Make the directory, with a copy of the configuration."""
        self._stamps.mkdir(parents=True, exist_ok=True)
        write_text(self.folder / "config.toml", self._source)

    @property
    def by_design(self) -> bool:
        """Whether the collection is a product as its generator gives it."""
        return self.config.collection.generator in GENERATORS

    @cached_property
    def collection(self) -> Collection:
        """The parametrised collection; of a folder of meshes, once its factors are known."""
        if self.by_design:
            return GENERATORS[str(self.config.collection.generator)]()
        return discovery.collection(self.folder, self.config)

    @property
    def bundle(self) -> Path:
        """Where the bundle goes."""
        return self.models / self.config.export.name / str(self.config.export.version)

    def data(self) -> dict[str, dict[str, Any]]:
        """Size, time and SHA-256 of each file of the collection, by name; of a generator's none.

        A file is read again only where its size or its time isn't that of ``data.json``.
        """
        source = self.config.collection.data
        known, found = self.known_data(), {}
        for path in data_files(source) if source else ():
            stat = path.stat()
            facts = {"bytes": stat.st_size, "time": stat.st_mtime_ns}
            before = known.get(path.name, {})
            if any(before.get(name) != value for name, value in facts.items()):
                with path.open("rb") as file:
                    before = {"sha256": hashlib.file_digest(file, "sha256").hexdigest()}
            found[path.name] = {**facts, "sha256": before["sha256"]}
        return found

    def known_data(self) -> dict[str, dict[str, Any]]:
        """The same of the files that `ingest` read last."""
        path = self.folder / "data.json"
        return json.loads(path.read_text()) if path.exists() else {}

    def log(self, event: str, **facts: Any) -> None:
        """Append one line to log.jsonl."""
        line = {"time": datetime.now(UTC).isoformat(timespec="milliseconds"), "event": event, **facts}
        with (self.folder / "log.jsonl").open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")

    def stamp(self, stage: str) -> dict[str, Any]:
        """What is known of a stage: its key, and its seconds once it is finished."""
        path = self._stamps / f"{stage}.json"
        return json.loads(path.read_text()) if path.exists() else {}

    def set_stamp(self, stage: str, **facts: Any) -> None:
        """Record a stage's key and, at its end, its seconds."""
        write_json(self._stamps / f"{stage}.json", facts)


def ingest(run: Run) -> None:
    """reference.npz, and of a folder of meshes shapes.npz."""
    if run.by_design:
        discovery.write_reference(run.folder, run.collection.reference, run.collection.scale)
    else:
        run.log("ingested", **discovery.ingest(run.folder, run.config, run.accepted))


def _nothing_to_find(run: Run) -> None:
    run.log("skipped", why="the generator gives factors and bounds itself")


def _discovered(
    find: Callable[[Path, Config], dict[str, Any]], by_design: Callable[[Run], None] = _nothing_to_find
) -> Callable[[Run], None]:
    """A stage that finds something in a collection, or does another thing where that is a product by design."""

    def stage(run: Run) -> None:
        if run.by_design:
            by_design(run)
        else:
            run.log("found", **find(run.folder, run.config))

    return stage


def given_factors(run: Run) -> None:
    """factors.json, as the generator says."""
    lists = run.collection.factors
    write_json(run.folder / "factors.json", {"factors": list(lists.values()), "names": list(lists)})


def _draw(run: Run, folder: Path, latents: FloatArray, title: str, *, shorten: bool) -> None:
    size = run.config.samples.part_size
    parts = draw(run.collection, folder, latents, size, title, shorten=shorten, scheduler=run.scheduler)
    for done, total, failed in parts:
        run.log("progress", what=title, done=done, total=total, failed=failed)


def samples(run: Run) -> None:
    """samples/: joint codes with their shapes, each factor's own, and the split."""
    settings, coordinates = run.config.samples, run.collection.coordinates
    folder = run.folder / "samples"
    code_rng, split_rng = (np.random.default_rng(s) for s in np.random.SeedSequence(settings.seed).spawn(2))
    own = settings.own(len(run.collection.factors))
    codes = coordinates.uniform(max(settings.count, *own), code_rng)
    _draw(run, folder, codes[: settings.count], "joint samples", shorten=True)
    codes = used(folder, codes)
    for j, (index, count) in enumerate(zip(run.collection.factors.values(), own, strict=True)):
        _draw(run, folder / f"factor-{j}", alone(codes[:count], index), f"samples of factor {j}", shorten=True)
    write_npz(
        folder / "split.npz", **split(indices(folder), settings.test_fraction, settings.validation_fraction, split_rng)
    )


def learner_of(run: Run, **how: Any) -> Learner:
    """The networks of a run whose samples are there, learned from a share of them, or with another seed."""
    return Learner(run.collection, run.config, run.folder, run.stamp("samples")["key"], **how)


def networks(run: Run) -> None:
    """networks/: one file for each fitted network, and the histories of all.

    Raises:
        SamplesError: too few to learn from.
    """
    folder = run.folder / "samples"
    kinds = {"joint samples": folder}
    kinds |= {f"samples of factor {name!r}": folder / f"factor-{j}" for j, name in enumerate(run.collection.factors)}
    for kind, path in kinds.items():
        if (found := len(indices(path))) < FEWEST:
            raise SamplesError(f"there are only {found} {kind}, and {FEWEST} are needed to learn from")
    learner = learner_of(run)
    learner.main()
    learner.monolithic()
    learner.variants()
    histories = learner.histories
    for fraction in run.config.networks.fractions:
        learner = learner_of(run, fraction=fraction)
        learner.main()
        learner.monolithic()
        free = learner_of(run, fraction=fraction, all_of_factors=True)
        free.main()
        histories |= learner.histories | free.histories
    for seed in run.config.networks.seeds:
        learner = learner_of(run, seed=seed)
        learner.main()
        learner.monolithic()
        histories |= learner.histories
    write_json(run.folder / "networks" / "histories.json", histories)


def evaluation(run: Run) -> None:
    """evaluation.json and gallery.npz."""

    def exact(name: str, latents: FloatArray) -> NDArray[np.float32]:
        folder = run.folder / "exact" / name
        _draw(run, folder, latents, f"exact shapes, {name}", shorten=False)
        samples = read(folder)
        result = np.full((len(latents), samples.nric.shape[1]), np.nan, dtype=np.float32)
        result[samples.index] = samples.nric
        return result

    figures, gallery = evaluate(partial(learner_of, run), run.config, exact)
    ingested = run.folder / "ingest.json"
    if ingested.exists():
        figures["prolongation"] = json.loads(ingested.read_text()).get("prolongation")
    write_npz(run.folder / "gallery.npz", **gallery)
    write_json(run.folder / "evaluation.json", figures)


def export_bundle(run: Run) -> None:
    """The bundle, in the models directory."""
    figures = json.loads((run.folder / "evaluation.json").read_text())
    digest = hashlib.sha256()
    for path in sorted((run.folder / "samples").rglob("*.npz")):
        digest.update(path.read_bytes())
    learner = learner_of(run)
    extras = discovery.extras(run.folder)
    folder = export(
        learner.main(), run.collection, run.config, figures, digest.hexdigest(), run.models, extras, learner.start()
    )
    run.log("exported", bundle=f"{folder.parent.name}/{folder.name}")


@dataclass(frozen=True)
class Stage:
    """One step of the line.

    Attributes:
        run: does it; finds and continues what an interrupted call has left.
        settings: the part of the configuration that it reads.
        results: what is removed where that part, or an earlier stage, has changed.
        amounts: settings that may change without it, since the stage knows what is there and what is missing.
    """

    run: Callable[[Run], None]
    settings: Callable[[Config], Sequence[BaseModel]]
    results: tuple[str, ...]
    amounts: frozenset[str] = frozenset()

    def keys(self, name: str, config: Config, before: str) -> dict[str, str]:
        """Digests of what the stage depends on: ``key`` of everything, ``basis`` of all but its amounts."""
        settings = [s.model_dump(mode="json") for s in self.settings(config)]
        rest = [{k: v for k, v in s.items() if k not in self.amounts} for s in settings]

        def digest(read: list[dict[str, Any]]) -> str:
            return hashlib.sha256(json.dumps([name, read, before]).encode()).hexdigest()

        return {"key": digest(settings), "basis": digest(rest)}


def _changes(before: dict[str, dict[str, Any]], now: dict[str, dict[str, Any]]) -> str:
    """Which data files are new, gone or others, in words."""

    def some(word: str, names: set[str]) -> str:
        more = ", …" if len(names) > 3 else ""
        return f"{len(names)} {word} ({', '.join(sorted(names)[:3])}{more})" if names else ""

    changed = {name for name in before.keys() & now.keys() if before[name]["sha256"] != now[name]["sha256"]}
    kinds = {"added": now.keys() - before.keys(), "removed": before.keys() - now.keys(), "changed": changed}
    return ", ".join(filter(None, (some(word, set(names)) for word, names in kinds.items())))


STAGES: dict[str, Stage] = {
    "ingest": Stage(ingest, lambda c: [c.collection], ("reference.npz", "shapes.npz", "ingest.json")),
    "mean": Stage(_discovered(discovery.mean), lambda c: [c.material], ("mean.npz",)),
    "modes": Stage(_discovered(discovery.modes), lambda c: [c.modes], ("modes.npz", "modes.json")),
    "factors": Stage(_discovered(discovery.factors, given_factors), lambda c: [c.factors], ("factors.json",)),
    "samples": Stage(samples, lambda c: [c.samples], ("samples",), frozenset({"count", "factor_counts"})),
    # Files of networks are named by samples and settings, so a change leaves those alone that it doesn't touch.
    "networks": Stage(networks, lambda c: [c.networks, c.monolithic, *c.variants.values()], ()),
    "evaluation": Stage(
        evaluation, lambda c: [c.evaluation], ("evaluation.json", "gallery.npz", "report.html", "exact")
    ),
    "export": Stage(export_bundle, lambda c: [c.export], ()),
}


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
    run.begin()
    data, known = run.data(), run.known_data()
    source = run.config.collection.data
    if data and not known and "seconds" in run.stamp("ingest"):
        raise OldRunError(
            f"{run.folder} is a run of version 0.1, which did not record its data files: status and report still read "
            "it, but it can't be continued. Name another directory with --out"
        )
    if source and known and not source.exists():
        show(f"data: {source} is not there any more; the run goes on with what ingest left")
        data = known
    elif known and (changes := _changes(known, data)):
        show(f"data: {changes}; all that follows from them is done again, from ingest on")
    key = json.dumps({name: facts["sha256"] for name, facts in data.items()}) if data else ""
    news = False
    for name, stage in STAGES.items():
        keys = stage.keys(name, run.config, key)
        key, stamp = keys["key"], run.stamp(name)
        if stamp.get("key") == key and "seconds" in stamp:
            show(f"{name}: done before ({stamp['seconds']:.0f} s)")
        else:
            if stamp and stamp["key"] != key and stamp.get("basis") != keys["basis"]:
                for result in stage.results:
                    path = run.folder / result
                    shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
            run.set_stamp(name, **keys)
            run.log("begin", stage=name)
            show(f"{name} …")
            start = time.monotonic()
            stage.run(run)
            seconds = time.monotonic() - start
            run.set_stamp(name, **keys, seconds=seconds)
            run.log("end", stage=name, seconds=round(seconds, 3))
            show(f"{name}: {seconds:.0f} s")
            news = True
        if name == "ingest" and data != known:
            write_json(run.folder / "data.json", data)
        lost = losses(run.folder, name)
        for loss in lost:
            show(f"  {loss.sentence}")
        if not keep_going:
            refuse(name, lost, f"{command} --keep-going" if command else "")
        if name == until:
            break
    if (run.folder / "evaluation.json").exists() and (news or not (run.folder / "report.html").exists()):
        show(f"report: {write_report(run.folder)}")
