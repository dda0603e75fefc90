#!/usr/bin/env bash
# Build the container image, run it as it should be run (read-only, no privileges, 2 GB) and check what it promises:
# what it holds, a shape, an end, and that it goes on through each of tests/attacks.py for a minute (SECONDS_EACH=60),
# with a key and without.
#
# Uses Docker where an engine answers. Elsewhere, as root on Debian: buildah, on a base image that mmdebstrap makes
# to stand in for python:3.11-slim-bookworm, and podman. Pip inside the build gets this machine's pip configuration.
set -euo pipefail
cd "$(dirname "$0")/.."

image=shapespace:image-test
container=shapespace-image-test-$$
scratch=$(mktemp -d)
engine=(:)
trap 'status=$?; "${engine[@]}" rm --force "$container" &>/dev/null || true; rm -rf "$scratch"; exit $status' EXIT

say() { printf '\033[1m%s\033[0m\n' "$*"; }
fail() { echo "image-test: $*" >&2; "${engine[@]}" logs "$container" 2>&1 | tail -n 50 >&2 || true; exit 1; }

# The environment's settings come first in pip's list and win over files.
pip_settings() {
  { python3 -m pip config list 2>/dev/null || true; } |
    sed -nE "s/^(:env:|global|install)\.([a-z-]+)='(.*)'$/\2 = \3/p" | awk -F ' = ' '!seen[$1]++'
}

build_with_docker() {
  engine=(docker)
  # Paths of this machine don't exist inside a Docker build.
  { echo '[global]'; pip_settings | grep -vE '(= |file://)/' || true; } >"$scratch/pip.conf"
  DOCKER_BUILDKIT=1 docker build --secret "id=pip,src=$scratch/pip.conf" --tag "$image" .
  run_options=(--publish 127.0.0.1::8000)
}

build_with_buildah() {
  engine=(podman --runtime runc --cgroup-manager cgroupfs)
  local base=localhost/shapespace-base:bookworm missing=() volumes=() word
  for tool in buildah mmdebstrap podman runc; do command -v "$tool" >/dev/null || missing+=("$tool"); done
  if ((${#missing[@]})); then
    ((EUID == 0)) || fail "no Docker engine answers; run as root, or install ${missing[*]}"
    apt-get update
    DEBIAN_FRONTEND=noninteractive apt-get install -y --no-install-recommends "${missing[@]}"
  fi
  if ! buildah inspect --type image "$base" &>/dev/null; then
    say "Making a base image"
    # shellcheck disable=SC2016 # $1 is mmdebstrap's to expand
    mmdebstrap --variant=minbase --include=ca-certificates,python3,python3-venv \
      --customize-hook='ln -s /usr/bin/python3 "$1/usr/local/bin/python"' bookworm "$scratch/base.tar"
    "${engine[@]}" import "$scratch/base.tar" "$base"
  fi

  { echo '[global]'; pip_settings; } >"$scratch/pip.conf"
  # Mount what the settings name; an index's pages link to files beside its own folder.
  while read -r word; do
    case $word in
      file:///*) word=${word#file://}; word=${word%/*} ;;
    esac
    [[ $word == /* && -e $word ]] && volumes+=(--volume "$word:$word:ro")
  done < <(pip_settings | cut -d = -f 2- | tr -s ' ' '\n' | sort -u)
  buildah build --isolation chroot --format docker --layers --from "$base" \
    --secret "id=pip,src=$scratch/pip.conf" "${volumes[@]}" --tag "$image" .
  local port
  port=$(python3 -c 'import socket; s = socket.socket(); s.bind(("127.0.0.1", 0)); print(s.getsockname()[1])')
  # Podman's default limits may be above what this machine can grant; its health timers would need systemd.
  export DISABLE_HC_SYSTEMD=true
  run_options=(--ulimit nofile=4096:4096 --ulimit nproc=4096:4096 --read-only-tmpfs=false
    --network host --env "SHAPESPACE_PORT=$port")
}

inside() { "${engine[@]}" exec "$container" "$@"; }

healthy() {
  case ${engine[0]} in
    docker) [ "$(docker inspect --format '{{.State.Health.Status}}' "$container")" = healthy ] ;;
    podman) "${engine[@]}" healthcheck run "$container" &>/dev/null ;;
  esac
}

running() { [ "$("${engine[@]}" inspect --format '{{.State.Running}}' "$container")" = true ]; }

say "Building"
if docker info &>/dev/null; then build_with_docker; else build_with_buildah; fi

# Starts the image with further options, and waits until it is healthy.
start() {
  "${engine[@]}" rm --force "$container" &>/dev/null || true
  "${engine[@]}" run --detach --name "$container" --read-only --cap-drop ALL --security-opt no-new-privileges \
    "${memory[@]}" "${run_options[@]}" "$@" "$image" >/dev/null
  for ((i = 0; i < 90; i++)); do
    running || fail "the server stopped by itself"
    if healthy; then break; fi
    sleep 1
  done
  healthy || fail "not healthy after 90 seconds"
  address=127.0.0.1:$(inside printenv SHAPESPACE_PORT)
  [ "${engine[0]}" = podman ] || address=$(docker port "$container" 8000)
}

# Not every machine lets an engine bound memory.
memory=(--memory 2g)
if ! "${engine[@]}" run --rm "${memory[@]}" "${run_options[@]}" "$image" true &>/dev/null; then
  echo "NOT tried: this machine bounds no memory" >&2
  memory=()
fi

say "Starting, read-only and without privileges"
start
echo "ok: healthy"

[ "$(inside id -u)" -ne 0 ] || fail "the server runs as root"
echo "ok: runs as user $(inside id -u)"
for folder in / /srv/shapespace /tmp; do
  ! inside touch "$folder/probe" 2>/dev/null || fail "$folder can be written"
done
echo "ok: read-only"
for tool in gcc cc make; do
  ! inside sh -c "command -v $tool" >/dev/null || fail "the image holds a build tool: $tool"
done
! inside python -c 'import torch' 2>/dev/null || fail "the image holds torch"
! inside python -c 'import pip' 2>/dev/null || fail "the server's environment holds pip"
echo "ok: neither build tools nor torch"

python3 - "http://$address" "$scratch/torus.glb" <<'PYTHON' || fail "no mesh came back"
import json, struct, sys, urllib.request

address, path = sys.argv[1:]
direct = urllib.request.build_opener(urllib.request.ProxyHandler({}))
request = urllib.request.Request(
    f"{address}/v1/models/freaky-torus/mesh",
    data=json.dumps({"latent": [1, 2, 3, 4]}).encode(),
    headers={"content-type": "application/json"},
)
with direct.open(request, timeout=60) as answer:
    body, kind = answer.read(), answer.headers["content-type"]
magic, version, length = struct.unpack("<4sII", body[:12])
if (kind, magic, version, length) != ("model/gltf-binary", b"glTF", 2, len(body)):
    sys.exit(f"not a GLB: {kind}, {body[:200]!r}")
with open(path, "wb") as file:
    file.write(body)
print(f"ok: a GLB of {len(body)} bytes")
PYTHON
if [ -d tests/node_modules/gltf-validator ]; then
  node tests/validate_gltf.mjs "$scratch/torus.glb" >"$scratch/report.json" || fail "$(cat "$scratch/report.json")"
  echo "ok: the Khronos validator finds no error"
fi

end() {
  local started=$SECONDS status
  "${engine[@]}" stop --time 10 "$container" >/dev/null
  status=$("${engine[@]}" inspect --format '{{.State.ExitCode}}' "$container")
  [ "$status" -eq 0 ] || fail "SIGTERM ended it with status $status after $((SECONDS - started)) s"
  echo "ok: SIGTERM ended it in $((SECONDS - started)) s with status 0"
}
end

# Attackers have another address than those who go on asking, where the engine leaves addresses as they are.
attacks() {
  python3 -m tests.attacks "http://$address" --seconds "${SECONDS_EACH:-60}" "$@" \
    $([ "${engine[0]}" = docker ] || echo "--source 127.0.0.2") || fail "an attack made it fall"
  running || fail "an attack ended it"
  end
}
say "Attacking it"
start
attacks
say "Attacking it, with a key that the attackers don't have"
SHAPESPACE_API_KEY=$(head -c 16 /dev/urandom | od -An -tx1 | tr -d ' \n')
export SHAPESPACE_API_KEY
start --env SHAPESPACE_API_KEY
attacks --stranger
say "Attacking it, with a key that the attackers have as well"
start --env SHAPESPACE_API_KEY
attacks

"${engine[@]}" image inspect --format 'ok: image of {{.Size}} bytes' "$image"
