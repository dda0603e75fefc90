"""One BLAS thread while shapes are computed, and the user's number of threads before and after."""

import threading

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

import shapespace
from shapespace.solve.blas_threads import OneBlasThread
from shapespace.solve.deadline import Deadline
from tests.service.conftest import ROOT


def numbers() -> set[int]:
    """Numbers of threads of NumPy's and SciPy's BLAS; MKL is always loaded for one thread."""
    return {library["num_threads"] for library in threadpool_info() if library["internal_api"] == "openblas"}


class Watching(Deadline):
    """A deadline that notes the number of BLAS threads whenever the work looks at it."""

    def __init__(self) -> None:
        super().__init__(600)
        self.seen: set[int] = set()

    @property
    def passed(self) -> bool:
        if not self.seen:
            self.seen |= numbers()
        return False


def test_the_number_returns_when_the_last_of_several_threads_leaves() -> None:
    with threadpool_limits(2, "blas"):
        inside, leave = threading.Event(), threading.Event()

        def stay() -> None:
            with OneBlasThread():
                inside.set()
                leave.wait(60)

        other = threading.Thread(target=stay)
        with OneBlasThread(), OneBlasThread():
            other.start()
            inside.wait(60)
        assert numbers() == {1}, "another thread is still at work"
        leave.set()
        other.join()
        assert numbers() == {2}


@pytest.mark.parametrize("call", ["shape", "encode", "edit", "fit_scan"])
def test_a_model_computes_in_its_callers_thread(call: str) -> None:
    model = shapespace.load(ROOT / "models" / "freaky-torus")
    code, deadline = model.sample(1)[0], Watching()
    vertices = model.decode(code[None])[0]
    with threadpool_limits(2, "blas"):
        given = {
            "shape": (code,),
            "encode": (vertices,),
            "edit": (code, {0: vertices[0] + 0.1}),
            "fit_scan": (np.random.default_rng(0).permutation(vertices)[:100],),
        }[call]
        getattr(model, call)(*given, deadline=deadline)
        assert deadline.seen == {1}
        assert numbers() == {2}
