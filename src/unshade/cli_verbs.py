"""The verbs that stand in modules of their own, one an area; add another area here."""

from __future__ import annotations

import click

from unshade import cli_dataset, cli_edit, cli_experiments, cli_export, cli_extract, cli_relight, cli_train, cli_transfer

AREAS = (cli_dataset, cli_edit, cli_experiments, cli_export, cli_extract, cli_relight, cli_train, cli_transfer)

VERBS: tuple[click.Command, ...] = tuple(verb for area in AREAS for verb in area.VERBS)
