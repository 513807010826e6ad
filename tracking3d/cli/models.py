"""``tracking3d models``: list known networks, download them into the user's cache, and verify them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tracking3d.cli.options import AsJson, Debug, Quiet
from tracking3d.errors import InputError

if TYPE_CHECKING:
    from tracking3d.features.networks.catalogue import KnownNetwork

app = typer.Typer(
    help="List known neural networks, download them into your cache, and verify them.", no_args_is_help=True
)

_RECOMMENDED = "recommended"
"""Name that stands for several networks."""


@app.command(name="list")
def list_networks(as_json: AsJson = False, debug: Debug = False) -> None:
    """List the known networks: purpose, size, licence, and whether they are in your cache."""
    import json

    from tracking3d.features.networks.catalogue import known_networks
    from tracking3d.features.networks.store import State, network_path, state_of

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

    table = Table("name", "purpose", "size", "licence", "state")
    for network in networks:
        licence = escape(network.licence) + (" [red]non-commercial[/]" if network.non_commercial else "")
        state = "fetched" if there[network.name] else "manual" if network.is_exported else ""
        state = state or ("recommended" if network.recommended else "")
        size = "" if network.size is None else f"{network.size / 1e6:.1f} MB"
        table.add_row(network.name, escape(network.purpose), size, licence, state)
    print_table(table)


@app.command()
def get(
    names: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="NAME...",
            help="Network names, as `models list` shows them; `recommended` stands for those that make masks better "
            "at little cost.",
        ),
    ] = None,
    everything: Annotated[
        bool,
        typer.Option(
            "--all",
            help="Download all networks; those with a non-commercial licence only with --accept-licence.",
        ),
    ] = False,
    file: Annotated[
        Path | None,
        typer.Option("--from", metavar="FILE", help="Use this file, downloaded elsewhere, instead."),
    ] = None,
    mirror: Annotated[
        str | None,
        typer.Option(
            envvar="TRACKING3D_MIRROR",
            help="Address of a folder that holds NAME.onnx; tried before the known addresses.",
        ),
    ] = None,
    accept_licence: Annotated[
        bool, typer.Option("--accept-licence", help="Accept a licence that forbids commercial use.")
    ] = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Download networks into your cache, and refuse files with an unexpected SHA-256.

    A stopped download continues where it stopped. Proxies are read from https_proxy and http_proxy.
    """
    from tracking3d.features.networks.catalogue import known_networks, recommended_networks
    from tracking3d.features.networks.download import adopt, fetch
    from tracking3d.features.networks.store import State, find_known, network_path, state_of

    several = names is not None and _RECOMMENDED in names
    if bool(names) == everything or (file is not None and (several or len(names or ()) != 1)):
        raise InputError("Give one or more NAMEs, or --all; with --from FILE exactly one NAME.")
    chosen = [
        network
        for name in names or ()
        for network in (recommended_networks() if name == _RECOMMENDED else [find_known(name)])
    ]
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
            checked = "" if network.sha256 else "; its SHA-256 is unknown and was not checked"
            typer.echo(f"{path}: {network.name}, {network.licence}{checked}")
    if failed:
        raise InputError(" ".join(dict.fromkeys(failed)))


@app.command()
def verify(
    name: Annotated[
        str | None, typer.Argument(metavar="[NAME]", help="Known network; default all in the cache.")
    ] = None,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Compare the SHA-256 of the networks in your cache with the known one."""
    import json

    from tracking3d.features.networks.catalogue import known_networks
    from tracking3d.features.networks.store import State, cache_folder, find_known, find_network, state_of

    if name is not None:
        find_network(find_known(name).name)
    networks = known_networks().values() if name is None else [find_known(name)]
    states = {network.name: state_of(network) for network in networks}
    states = {known: state for known, state in states.items() if state is not State.ABSENT}
    if as_json:
        typer.echo(json.dumps(states, indent=2))
    elif not states:
        typer.echo(f"{cache_folder()} holds no network; `tracking3d models list` shows the known ones.")
    else:
        for known, state in states.items():
            typer.echo(f"{known}: {_STATES[state]}")
    if damaged := [known for known, state in states.items() if state is State.DAMAGED]:
        raise InputError(
            f"{', '.join(damaged)}: not the known file; download it again with `tracking3d models get {damaged[0]}`."
        )


_STATES = {
    "ok": "ok",
    "unchecked": "in the cache, but its SHA-256 is unknown",
    "damaged": "not the known file",
}


@contextmanager
def _progress(network: KnownNetwork, quiet: bool) -> Iterator[Callable[[int], None]]:
    """A progress bar on the standard error; yields the function to call with the number of new bytes."""
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
