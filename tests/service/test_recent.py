"""Recent answers: never more bytes than allowed, never another answer than a fresh one."""

import re
from pathlib import Path

import httpx
import numpy as np

from shapespace.service.http.recent import Answer, RecentAnswers
from tests.service.bundles import write_bundle
from tests.service.conftest import Start

CODE = "0.11,0.72,0.43"


def answer(size: int) -> Answer:
    return Answer(bytes(size), {"Shape-Diagnostics": "{}"})


def test_what_is_kept_never_grows_over_the_limit_and_the_last_is_always_there() -> None:
    recent, rng = RecentAnswers(100_000), np.random.default_rng(0)
    for k in range(500):
        tag = str(rng.integers(40))
        recent.put(tag, answer(int(rng.integers(1, 30_000))))
        assert recent.size <= 100_000
        assert recent.get(tag)
        recent.get(str(k % 40))
    assert len(recent) > 3
    assert recent.size == sum(recent._answers[tag].size for tag in recent._answers)


def test_what_nobody_asked_for_goes_first() -> None:
    recent = RecentAnswers(3 * answer(1000).size)
    for tag in "abc":
        recent.put(tag, answer(1000))
    assert recent.get("a")
    recent.put("d", answer(1000))
    assert [tag for tag in "abcd" if recent.get(tag)] == ["a", "c", "d"]


def test_an_answer_that_is_too_large_is_not_kept_and_drives_out_no_other() -> None:
    recent = RecentAnswers(10_000)
    recent.put("small", answer(100))
    recent.put("large", answer(10_000))
    assert recent.get("small")
    assert not recent.get("large")
    recent.put("small", answer(10_000))  # the same again, grown
    assert len(recent) == recent.size == 0


def test_a_second_answer_is_the_first_one_without_its_work(tmp_path: Path, start: Start) -> None:
    models = tmp_path / "models"
    write_bundle(models)
    answers = {}
    for cache in (0, 2**20):
        with httpx.Client(base_url=start(models, cache=cache).url, timeout=120) as client:
            answers[cache] = [client.get("/v1/models/small/mesh", params={"latent": CODE}) for _ in range(2)]
    contents = {a.raise_for_status().content for pair in answers.values() for a in pair}
    assert len(contents) == 1
    for header in ("ETag", "Shape-Diagnostics", "Content-Type", "Content-Disposition"):
        assert len({a.headers[header] for pair in answers.values() for a in pair}) == 1
    work = [
        [sum(map(float, re.findall(r"dur=([\d.]+)", a.headers["Server-Timing"]))) for a in answers[cache]]
        for cache in (0, 2**20)
    ]
    assert work[0][0] > 0
    assert work[0][1] > 0
    assert work[1][0] > 0
    assert work[1][1] == 0
