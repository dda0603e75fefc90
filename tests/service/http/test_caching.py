"""Cached answers: never more bytes than allowed, and never different from a fresh answer."""

import re

import httpx
import numpy as np

from shapespace.service.http.caching import AnswerCache
from shapespace.service.use_cases.batch import EncodedFile


def answer(size: int) -> EncodedFile:
    return EncodedFile(bytes(size), {})


def test_what_is_kept_never_grows_over_the_limit_and_the_last_is_always_there() -> None:
    cache, rng = AnswerCache(100_000), np.random.default_rng(0)
    for k in range(500):
        tag = str(rng.integers(40))
        cache.keep(tag, answer(int(rng.integers(1, 30_000))))
        assert sum(map(cache.getsizeof, cache.values())) <= 100_000
        assert cache.get(tag)
        cache.get(str(k % 40))
    assert len(cache) > 3
    assert cache.currsize == sum(map(cache.getsizeof, cache.values()))


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


def test_a_second_answer_is_the_first_one_without_its_work(client: httpx.Client) -> None:
    first, second = (client.get("/v1/models/small/mesh", params={"latent": "0.11,0.72,0.43"}) for _ in range(2))
    assert first.raise_for_status().content == second.raise_for_status().content
    for header in ("ETag", "Shape-Diagnostics", "Content-Type", "Content-Disposition"):
        assert first.headers[header] == second.headers[header]
    work = [sum(map(float, re.findall(r"dur=([\d.]+)", a.headers["Server-Timing"]))) for a in (first, second)]
    assert work[0] > work[1] == 0
