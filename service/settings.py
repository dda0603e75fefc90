"""Settings of the server, from environment variables ``SHAPESPACE_*``."""

from __future__ import annotations

import ipaddress
import os
import re
from enum import StrEnum
from pathlib import Path
from typing import Annotated

from pydantic import (
    BeforeValidator,
    Field,
    NonNegativeFloat,
    PositiveFloat,
    PositiveInt,
    SecretStr,
    ValidationInfo,
    field_validator,
)
from pydantic_settings import BaseSettings, NoDecode, SettingsConfigDict

from shapespace.bundle.finding import BUNDLED
from shapespace.service.versions import FILE_NAME, DefaultVersions

PREFIX = "SHAPESPACE_"


class LogFormat(StrEnum):
    """Format of a log line: text, or one JSON object."""

    TEXT = "text"
    JSON = "json"


def cpu_quota(cgroup: Path = Path("/sys/fs/cgroup")) -> int:
    """Return the number of processors that this process may use, by its affinity and its control group; at least 1."""
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    try:
        quota, period = (cgroup / "cpu.max").read_text().split()
        share = float(quota) / float(period)  # "max" is no number, and means no quota
    except (OSError, ValueError):
        return count
    return max(1, min(count, round(share)))


def default_models_dir() -> Path:
    """Return ``models`` in the working directory, or the models that are installed with the package."""
    return Path("models") if Path("models").exists() else BUNDLED


def _split(value: object) -> object:
    return tuple(filter(None, map(str.strip, value.split(",")))) if isinstance(value, str) else value


def _versions(value: object) -> object:
    return DefaultVersions.parse(value) if isinstance(value, str) else value


#: Values separated by commas.
Names = Annotated[tuple[str, ...], NoDecode, BeforeValidator(_split)]


class Settings(BaseSettings):
    """Settings of the server; docs/reference/settings.md lists them."""

    model_config = SettingsConfigDict(env_prefix=PREFIX, env_ignore_empty=True, frozen=True, allow_inf_nan=False)

    models_dir: Path = Field(
        default_factory=default_models_dir,
        description="folder of bundles, NAME/VERSION/; by default `models` here, or the installed models",
    )
    default_versions: Annotated[DefaultVersions, NoDecode, BeforeValidator(_versions)] = Field(
        default=DefaultVersions(),
        description="version of each model that answers requests without a version, as figure=3,hand=2, or shares of "
        "the codes, as figure=3:95,4:5; by default the newest",
    )
    default_versions_file: Path | None = Field(
        default=None,
        validate_default=True,
        description="file with default versions, which every reload reads again; by default `default-versions` in the "
        "models folder",
    )
    host: str = Field(default="127.0.0.1", description="address to listen on")
    port: int = Field(default=8000, ge=0, le=65535, description="port to listen on; 0 takes a free one")
    metrics_port: int | None = Field(
        default=None,
        ge=0,
        le=65535,
        description="port that answers /metrics without a key; 0 takes a free one; by default none",
    )
    workers: PositiveInt = Field(
        default_factory=cpu_quota,
        description="shapes computed at once, at most half of them for long calls; by default the processors allowed",
    )
    queue: int = Field(default=32, ge=0, description="requests that may wait for a worker; further ones get 503")
    deadline: PositiveFloat = Field(default=60.0, description="seconds a request may take before it gets 504")
    max_body: PositiveInt = Field(default=8 * 2**20, description="largest request body, in bytes")
    max_upload: PositiveInt = Field(default=64 * 2**20, description="largest mesh file sent to be encoded, in bytes")
    max_codes: PositiveInt = Field(default=256, description="most latent codes in one request")
    max_frames: PositiveInt = Field(default=600, description="most frames of an interpolation")
    cache: int = Field(
        default=32 * 2**20, ge=0, description="bytes of recent answers that are kept to answer them again; 0 keeps none"
    )
    watch: NonNegativeFloat = Field(
        default=2.0, description="seconds between checks of the models folder for changes; 0 never checks"
    )
    drain: NonNegativeFloat = Field(
        default=2.0, description="seconds after SIGTERM in which new requests are still answered, and readiness is 503"
    )
    max_connections: PositiveInt = Field(default=512, description="most connections at once")
    hosts: Names = Field(
        default=(),
        description="host names that requests may use, separated by commas, or *; by default any, and without a key "
        "on loopback only names of this machine",
    )
    trusted_proxies: Names = Field(
        default=(), description="addresses or networks of proxies whose X-Forwarded-For is trusted"
    )
    api_key: SecretStr | None = Field(default=None, description="key that requests must have; by default none")
    cors_origins: Names = Field(default=(), description="origins whose pages may call, separated by commas, or *")
    embed_origins: Names = Field(
        default=(), description="origins whose pages may show the page's viewer in a frame, separated by commas, or *"
    )
    log_format: LogFormat = Field(default=LogFormat.TEXT, description="text, or json for one object a line")

    @field_validator("default_versions_file")
    @classmethod
    def _readable(cls, file: Path | None, others: ValidationInfo) -> Path | None:
        if file is not None and not file.exists():
            raise ValueError(f"there is no file {file}")
        if file is None and "models_dir" in others.data:
            file = others.data["models_dir"] / FILE_NAME
        if file is not None:
            DefaultVersions.read(file)
        return file

    @field_validator("api_key")
    @classmethod
    def _printable_key(cls, key: SecretStr | None) -> SecretStr | None:
        if key is not None and not re.fullmatch(r"[!-~]([ -~]*[!-~])?", key.get_secret_value()):
            raise ValueError("a key has printable ASCII characters only, without line breaks or spaces around it")
        return key

    @field_validator("trusted_proxies")
    @classmethod
    def _networks(cls, proxies: tuple[str, ...]) -> tuple[str, ...]:
        # Uvicorn takes a network with host bits for a name.
        return tuple(str(ipaddress.ip_network(proxy, strict=False)) for proxy in proxies)

    @field_validator("cors_origins", "embed_origins")
    @classmethod
    def _origins(cls, origins: tuple[str, ...]) -> tuple[str, ...]:
        for origin in origins:
            if origin != "*" and not re.fullmatch(r"https?://[^/\s]+", origin):
                raise ValueError(f"an origin is like https://a.example, without a path, or *, not {origin}")
        return origins


def is_loopback(host: str) -> bool:
    """Return whether only this machine can reach an address or name."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def unknown_variables() -> list[str]:
    """Return environment variables with the prefix of settings that are no settings."""
    known = {(PREFIX + name).upper() for name in Settings.model_fields}
    return sorted(name for name in os.environ if name.upper().startswith(PREFIX) and name.upper() not in known)
