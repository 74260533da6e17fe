"""Synthetic data as files: a folder of shards and a manifest that counts and seals them.

A shard is a safetensors file with the table of all nodes of some trees: their pictures in 8 bits, their kinds, their operands
and their numbers. Every operator in it is an example. `manifest.json` is written anew after each shard, so a folder whose
making was cut short says itself what is there, and the same call goes on.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load, save

from unshade import __version__, crew
from unshade.environments import versions
from unshade.errors import OutputError, UnshadeError
from unshade.files import write_whole
from unshade.forest import CODES, Forest, Plant
from unshade.sphere import disc_mask, sphere_normals
from unshade.synthesis import GROVE, OPERATORS, TYPES, Batch, Style, plants, type_codes

MANIFEST = "manifest.json"
FORMAT = "unshade-dataset"
VERSION = 1

BYTES_OF_A_TREE = 45
"""Times the square of the size: nodes of a tree times channels, a little more than on the average."""

Entry: TypeAlias = "dict[str, Any]"
"""What the manifest says of one shard."""


class DatasetError(UnshadeError):
    """A folder of synthetic data that cannot be read or is not what it says."""


@dataclass(frozen=True)
class Plan:
    """What a folder is to hold: trees 0 to ``trees`` - 1 of a stream, see `synthesis.trees`."""

    style: Style
    split: str
    seed: int
    size: int
    trees: int
    shard_trees: int

    def shards(self) -> list[tuple[int, int]]:
        """(first tree, trees) of each shard."""
        return [(first, min(self.shard_trees, self.trees - first)) for first in range(0, self.trees, self.shard_trees)]


@dataclass(frozen=True)
class _Job:
    plan: Plan
    index: int
    folder: Path


def make(plan: Plan, folder: Path, workers: int = 1, done: Callable[[int, int], None] = lambda made, total: None) -> dict[str, Any]:
    """Write what is missing of a data set or not what its manifest says, and return the manifest.

    Args:
        plan: what to write.
        folder: where; made when missing. One that holds part of the same data set is completed.
        workers: processes.
        done: called with the shards that are there and their total.
    Raises:
        OutputError: the folder cannot be written, has no room, or holds something else.
    """
    entries = _begun(plan, folder)
    jobs = [_Job(plan, index, folder) for index in range(len(plan.shards())) if index not in entries]
    _check_room(plan, folder, len(jobs))
    _seal(plan, folder, entries)
    total = len(jobs) + len(entries)
    done(len(entries), total)
    try:
        for job, entry in crew.run(jobs, workers, _made, _lost):
            if isinstance(entry, UnshadeError):
                raise entry
            entries[job.index] = entry
            _seal(plan, folder, entries)
            done(len(entries), total)
    finally:
        for stray in folder.glob(".unshade-*.tmp"):
            stray.unlink(missing_ok=True)
    return read_manifest(folder)


def read_manifest(folder: Path) -> dict[str, Any]:
    """The manifest of a folder. Raises DatasetError."""
    path = folder / MANIFEST
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise DatasetError(f"{folder}: expected a data set with a {MANIFEST}: {error}") from None
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT or not isinstance(manifest.get("shards"), list):
        raise DatasetError(f"{path}: not the manifest of a data set")
    if manifest.get("version") != VERSION:
        raise DatasetError(f"{path}: version {manifest.get('version')} of the format, this program reads {VERSION}")
    return manifest


def check(folder: Path) -> list[str]:
    """What is wrong with a folder: shards that are missing, changed or not what the manifest says. Raises DatasetError."""
    manifest = read_manifest(folder)
    wrong = [] if manifest["complete"] else [f"{len(manifest['shards'])} of {len(_plan(manifest).shards())} shards were made"]
    for entry in manifest["shards"]:
        try:
            nodes = read_shard(folder, entry)
        except DatasetError as error:
            wrong.append(str(error))
            continue
        if int((nodes["left"] >= 0).sum()) != entry["examples"] or len(nodes["kind"]) != entry["nodes"]:
            wrong.append(f"{entry['file']}: {len(nodes['kind'])} nodes, the manifest says {entry['nodes']}")
    return wrong


def read_shard(folder: Path, entry: Entry) -> dict[str, torch.Tensor]:
    """The table of a shard: image (N, 3, S, S) uint8, kind, left, right, mask, tree (N,) and numbers (N, 6). Raises DatasetError."""
    data = _bytes(folder, entry)
    try:
        return load(data)
    except SafetensorError as error:
        raise DatasetError(f"{folder / str(entry['file'])}: not a shard: {error}") from None


def _bytes(folder: Path, entry: Entry) -> bytes:
    """Of a shard as it was written. Raises DatasetError."""
    path = folder / str(entry["file"])
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read: {error.strerror or error}") from None
    if hashlib.sha256(data).hexdigest() != entry["sha256"]:
        raise DatasetError(f"{path}: its checksum is not the manifest's: {len(data)} bytes, expected {entry['bytes']}")
    return data


def _is_whole(folder: Path, entry: Entry) -> bool:
    try:
        _bytes(folder, entry)
    except DatasetError:
        return False
    return True


def shard_batches(folder: Path, *, batch: int, seed: int, start: int = 0, device: torch.device | str = "cpu") -> Iterator[Batch]:
    """Endless shuffled examples of a written data set, the first of them batch ``start``; as `synthesis.batches` gives them.

    Every round goes through all shards in an order of its own; the few examples that fill no batch of a shard are left
    out of that round. Raises DatasetError.
    """
    manifest = read_manifest(folder)
    entries = [entry for entry in manifest["shards"] if entry["examples"] >= batch]
    if not entries:
        raise DatasetError(f"{folder}: no shard has {batch} examples, which one batch needs")
    each_round = sum(entry["examples"] // batch for entry in entries)
    turn, skipped = divmod(start, each_round)
    while True:
        generator = torch.Generator().manual_seed((seed * 1_000_003 + turn) % (1 << 62))
        for index in torch.randperm(len(entries), generator=generator).tolist():
            count = entries[index]["examples"] // batch
            order = torch.randperm(entries[index]["examples"], generator=generator)
            if skipped >= count:
                skipped -= count
                continue
            nodes = read_shard(folder, entries[index])
            for k in range(skipped, count):
                yield _batch(nodes, order[k * batch : (k + 1) * batch]).to(device)
            skipped = 0
        turn += 1


def _batch(nodes: dict[str, torch.Tensor], chosen: torch.Tensor) -> Batch:
    rows = (nodes["left"] >= 0).nonzero()[chosen, 0]
    left, right, mask = (nodes[name][rows].long() for name in ("left", "right", "mask"))
    images = [nodes["image"][where].float() / 255.0 for where in (rows, left, right, mask.clamp(min=0))]
    masks = images[3][:, :1] * (mask >= 0)[:, None, None, None]
    kinds, codes = nodes["kind"].long(), type_codes()
    return Batch(images[0], images[1], images[2], kinds[rows], masks, codes[kinds[left]], codes[kinds[right]])


def _made(job: _Job) -> Entry | UnshadeError:
    """Write one shard; the error is returned, since this may run in another process."""
    torch.set_num_threads(1)
    first, count = job.plan.shards()[job.index]
    name = f"shard-{job.index:05d}.safetensors"
    try:
        table = _table([_plant(job.plan, number) for number in range(first, first + count)], first, job.plan.size)
        data = save(table)
        write_whole(job.folder / name, data)
    except UnshadeError as error:
        return error
    operators = table["left"] >= 0
    children = torch.cat([table["left"][operators], table["right"][operators]]).long()
    return {
        "file": name,
        "first_tree": first,
        "trees": count,
        "nodes": len(operators),
        "examples": int(operators.sum()),
        "operators": _counts(table["kind"][operators].long(), OPERATORS),
        "children": _counts(type_codes()[table["kind"][children].long()], TYPES),
        "bytes": len(data),
        "sha256": hashlib.sha256(data).hexdigest(),
    }


def _lost(job: _Job, code: int | None) -> UnshadeError:
    return OutputError(f"{job.folder}: the process that made shard {job.index} ended with code {code}; the same call goes on from here")


def _plant(plan: Plan, number: int) -> Plant:
    return plants(plan.style, plan.split, plan.seed, number // GROVE)[number % GROVE]


def _table(grown: list[Plant], first: int, size: int) -> dict[str, torch.Tensor]:
    """All nodes of some trees, the first of which has the number ``first``."""
    inside = disc_mask(size)[0]
    normals = sphere_normals(size)[:, inside][:, None]
    images = []
    # A few trees at a time, as numbers take four times the room of bytes.
    for start in range(0, len(grown), GROVE):
        values = Forest(grown[start : start + GROVE]).shade(normals)
        image = torch.zeros(len(values), 3, size, size, dtype=torch.uint8)
        image[..., inside] = (values[:, :, 0] * 255.0).round().to(torch.uint8)
        images.append(image)
    forest = Forest(grown)
    columns = {
        "kind": forest.kinds,
        "left": forest.links[0],
        "right": forest.links[1],
        "mask": forest.links[2],
        "tree": forest.tree + first,
    }
    table = {name: torch.from_numpy(np.ascontiguousarray(column)) for name, column in columns.items()}
    return {**table, "image": torch.cat(images), "numbers": torch.cat([plant.numbers for plant in grown])}


def _counts(classes: torch.Tensor, names: tuple[str, ...]) -> dict[str, int]:
    return dict(zip(names, torch.bincount(classes, minlength=len(names)).tolist(), strict=True))


def _plan(manifest: dict[str, Any]) -> Plan:
    return Plan(**{field.name: manifest[field.name] for field in dataclasses.fields(Plan)})


def _begun(plan: Plan, folder: Path) -> dict[int, Entry]:
    """What is there already and whole, by index. Raises OutputError where it is something else."""
    if not (folder / MANIFEST).exists():
        if folder.is_dir() and any(folder.iterdir()):
            raise OutputError(f"{folder}: expected an empty folder, a new one, or one with a {MANIFEST}")
        return {}
    try:
        manifest = read_manifest(folder)
    except DatasetError as error:
        raise OutputError(str(error)) from None
    for name, wanted in dataclasses.asdict(plan).items():
        # A longer data set begins with the shards of a shorter one.
        if manifest.get(name) != wanted and name != "trees":
            raise OutputError(f"{folder}: holds a data set with {name} {manifest.get(name)}, not {wanted}; take another folder")
    shards = plan.shards()
    found: dict[int, Entry] = {}
    for entry in manifest["shards"]:
        index = entry["first_tree"] // plan.shard_trees
        if index < len(shards) and shards[index] == (entry["first_tree"], entry["trees"]) and _is_whole(folder, entry):
            found[index] = entry
    if manifest["trees"] > plan.trees:
        raise OutputError(f"{folder}: holds {manifest['trees']} trees, more than {plan.trees}; take another folder")
    return found


def _seal(plan: Plan, folder: Path, entries: dict[int, Entry]) -> None:
    """Write the manifest of what is there. Raises OutputError."""
    shards = [entries[index] for index in sorted(entries)]
    totals = {name: sum(entry[name] for entry in shards) for name in ("nodes", "examples", "bytes")}
    classes = {
        name: {kind: sum(entry[name][kind] for entry in shards) for kind in known}
        for name, known in (("operators", OPERATORS), ("children", TYPES))
    }
    manifest = {
        "format": FORMAT,
        "version": VERSION,
        "made_with": __version__,
        **dataclasses.asdict(plan),
        "complete": len(entries) == len(plan.shards()),
        **totals,
        **classes,
        "kinds": CODES,
        "environments": versions(plan.split),
        "shards": shards,
    }
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be made: {error.strerror}") from error
    write_whole(folder / MANIFEST, json.dumps(manifest, indent=1).encode())


def _check_room(plan: Plan, folder: Path, missing: int) -> None:
    """Fail before the work rather than after it. Raises OutputError."""
    there = folder
    while not there.exists():
        there = there.parent
    needed = BYTES_OF_A_TREE * plan.size**2 * min(plan.trees, missing * plan.shard_trees)
    free = shutil.disk_usage(there).free
    if needed > free:
        raise OutputError(f"{folder}: needs about {needed / 1e9:.1f} GB, but {free / 1e9:.1f} GB are free")
