"""``tracking3d models``: networks that are known by name, fetched into the user's cache and verified."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tracking3d.cli.options import Debug, Quiet
from tracking3d.errors import InputError

if TYPE_CHECKING:
    from tracking3d.networks.catalogue import KnownNetwork

app = typer.Typer(
    help="Known networks: list them, fetch them into your cache, verify them.", no_args_is_help=True
)

AsJson = Annotated[bool, typer.Option("--json", help="Print JSON only.")]


@app.command(name="list")
def list_networks(as_json: AsJson = False, debug: Debug = False) -> None:
    """List the known networks: what for, size, licence, and whether they are in the cache."""
    import json

    from tracking3d.networks.catalogue import known_networks
    from tracking3d.networks.store import State, network_path, state_of

    networks = list(known_networks().values())
    there = {network.name: state_of(network, check=False) is not State.ABSENT for network in networks}
    if as_json:
        rows = [
            {**network.model_dump(), "path": str(network_path(network)), "fetched": there[network.name]}
            for network in networks
        ]
        typer.echo(json.dumps(rows, indent=2))
        return
    from rich.markup import escape
    from rich.table import Table

    from tracking3d.cli.tables import print_table

    table = Table("name", "what for", "size", "licence", "state")
    for network in networks:
        licence = escape(network.licence) + (" [red]non-commercial[/]" if network.non_commercial else "")
        state = "fetched" if there[network.name] else "manual" if network.address is None else ""
        size = "" if network.size is None else f"{network.size / 1e6:.1f} MB"
        table.add_row(network.name, escape(network.purpose), size, licence, state)
    print_table(table)


@app.command()
def get(
    names: Annotated[
        list[str] | None, typer.Argument(metavar="NAME...", help="Names that `models list` shows.")
    ] = None,
    everything: Annotated[
        bool,
        typer.Option(
            "--all",
            help="All that can be fetched; those under a non-commercial licence with --accept-licence.",
        ),
    ] = False,
    file: Annotated[
        Path | None,
        typer.Option("--from", metavar="FILE", help="Take this file, fetched elsewhere, instead."),
    ] = None,
    mirror: Annotated[
        str | None,
        typer.Option(
            envvar="TRACKING3D_MIRROR",
            help="Address of a folder that has NAME.onnx; tried before the known ones.",
        ),
    ] = None,
    accept_licence: Annotated[
        bool, typer.Option("--accept-licence", help="Accept a licence that forbids commercial use.")
    ] = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Fetch networks into your cache; what is not the known file, by its SHA-256, is refused.

    A download that was stopped goes on where it was. Proxies are taken from https_proxy and http_proxy.
    """
    from tracking3d.networks.catalogue import known_networks
    from tracking3d.networks.download import adopt, fetch
    from tracking3d.networks.store import State, find_known, network_path, state_of

    if bool(names) == everything or (file is not None and len(names or ()) != 1):
        raise InputError("Say which network: one or more NAMEs, or --all; with --from FILE exactly one NAME.")
    chosen = [find_known(name) for name in names or ()]
    if everything:
        fetchable = [network for network in known_networks().values() if network.addresses]
        chosen = [network for network in fetchable if accept_licence or not network.non_commercial]
    failed: list[str] = []
    for network in chosen:
        try:
            if file is not None:
                path = adopt(network, file, accept_licence=accept_licence)
            elif state_of(network) in (State.OK, State.UNCHECKED):
                path = network_path(network)
            else:
                with _progress(network, quiet) as listener:
                    path = fetch(network, accept_licence=accept_licence, listener=listener, mirror=mirror)
        except InputError as error:
            failed.append(str(error))
            continue
        if not quiet:
            checked = "" if network.sha256 else ", whose SHA-256 is not known and was not checked"
            typer.echo(f"{path}: {network.name}, {network.licence}{checked}")
    if failed:
        raise InputError(" ".join(failed))


@app.command()
def verify(
    name: Annotated[
        str | None, typer.Argument(metavar="[NAME]", help="A known network; all in the cache if left out.")
    ] = None,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Compare the networks in your cache with their known SHA-256."""
    import json

    from tracking3d.networks.catalogue import known_networks
    from tracking3d.networks.store import State, cache_folder, find_known, find_network, state_of

    if name is not None:
        find_network(find_known(name).name)
    networks = known_networks().values() if name is None else [find_known(name)]
    states = {network.name: state_of(network) for network in networks}
    states = {known: state for known, state in states.items() if state is not State.ABSENT}
    if as_json:
        typer.echo(json.dumps(states, indent=2))
    elif not states:
        typer.echo(f"{cache_folder()} holds no network; `tracking3d models list` shows those there are.")
    else:
        for known, state in states.items():
            typer.echo(f"{known}: {_STATES[state]}")
    if damaged := [known for known, state in states.items() if state is State.DAMAGED]:
        raise InputError(
            f"{', '.join(damaged)}: not the known file; fetch it anew with `tracking3d models get {damaged[0]}`."
        )


_STATES = {"ok": "ok", "unchecked": "there, but its SHA-256 is not known", "damaged": "not the known file"}


@contextmanager
def _progress(network: KnownNetwork, quiet: bool) -> Iterator[Callable[[int], None]]:
    """A progress bar on the standard error; yields what to tell the number of bytes that have arrived."""
    from rich.console import Console
    from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    bar = Progress(
        TextColumn(network.name),
        BarColumn(bar_width=24),
        DownloadColumn(),
        TimeRemainingColumn(compact=True),
        console=console,
        disable=quiet or not console.is_terminal,
        transient=True,
    )
    task = bar.add_task("", total=network.size)
    with bar:
        yield lambda count: bar.update(task, advance=count)
