"""What can be set from outside, as environment variables ``SHAPESPACE_*``."""

from __future__ import annotations

import os
from pathlib import Path

from pydantic import Field, PositiveFloat, PositiveInt
from pydantic_settings import BaseSettings, SettingsConfigDict


def cpu_quota(cgroup: Path = Path("/sys/fs/cgroup")) -> int:
    """Processors this process may use, at least 1: its affinity within the quota of its control group."""
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    try:
        quota, period = (cgroup / "cpu.max").read_text().split()
        share = float(quota) / float(period)  # "max" is no number: no quota
    except (OSError, ValueError):
        try:  # control groups of version 1; −1 stands for no quota
            quota, period = ((cgroup / "cpu" / f"cpu.cfs_{x}_us").read_text() for x in ("quota", "period"))
            share = float(quota) / float(period)
        except (OSError, ValueError):
            share = -1.0
    return max(1, min(count, round(share))) if share > 0 else count


class Settings(BaseSettings):
    """Settings of the server; the README lists them."""

    model_config = SettingsConfigDict(env_prefix="SHAPESPACE_", frozen=True)

    models_dir: Path = Field(default=Path("models"), description="folder of bundles, NAME/VERSION/")
    host: str = Field(default="127.0.0.1", description="address to listen on")
    port: int = Field(default=8000, ge=0, le=65535, description="port to listen on; 0 takes a free one")
    workers: PositiveInt = Field(
        default_factory=cpu_quota, description="shapes computed at once; by default the processors allowed"
    )
    queue: int = Field(default=32, ge=0, description="requests that may wait for a worker before others get 503")
    deadline: PositiveFloat = Field(default=60.0, description="seconds a request may take before it gets 504")
    max_body: PositiveInt = Field(default=8 * 2**20, description="largest request body, in bytes")
    max_codes: PositiveInt = Field(default=256, description="most latent codes in one request")
    max_frames: PositiveInt = Field(default=600, description="most frames of an interpolation")
