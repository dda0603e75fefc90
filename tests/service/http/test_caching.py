"""Cached answers: never more bytes than allowed, and never different from a fresh answer."""

import re
from pathlib import Path

import httpx
import numpy as np

from shapespace.service.http.caching import AnswerCache, CachedAnswer
from tests.service.bundles import write_bundle
from tests.service.conftest import Start

CODE = "0.11,0.72,0.43"


def answer(size: int) -> CachedAnswer:
    return CachedAnswer(bytes(size), {"Shape-Diagnostics": "{}"})


def test_what_is_kept_never_grows_over_the_limit_and_the_last_is_always_there() -> None:
    cache, rng = AnswerCache(100_000), np.random.default_rng(0)
    for k in range(500):
        tag = str(rng.integers(40))
        cache.keep(tag, answer(int(rng.integers(1, 30_000))))
        assert sum(kept.size for kept in cache.values()) <= 100_000
        assert cache.get(tag)
        cache.get(str(k % 40))
    assert len(cache) > 3
    assert cache.currsize == sum(kept.size for kept in cache.values())


def test_what_nobody_asked_for_goes_first() -> None:
    cache = AnswerCache(3 * answer(1000).size)
    for tag in "abc":
        cache.keep(tag, answer(1000))
    assert cache.get("a")
    cache.keep("d", answer(1000))
    assert [tag for tag in "abcd" if cache.get(tag)] == ["a", "c", "d"]


def test_an_answer_that_is_too_large_is_not_kept_and_drives_out_no_other() -> None:
    cache = AnswerCache(10_000)
    cache.keep("small", answer(100))
    cache.keep("large", answer(10_000))
    assert cache.get("small")
    assert not cache.get("large")


def test_a_cache_without_room_keeps_nothing() -> None:
    cache = AnswerCache(0)
    cache.keep("small", answer(1))
    assert not cache


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
