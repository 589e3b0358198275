"""`fognav node`: sensor nodes, from a place on the map to their calibration, and simulated ones."""

import asyncio
import math
import time
from collections.abc import Coroutine
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeVar

import msgspec
import typer

from fog_contracts import channels as ch
from fog_contracts.messages import NodeCalibration, NodeReading, NodeUpdate
from fog_contracts.site import NodeSite
from fog_runtime.clock import SystemClock
from fog_runtime.configuration.site import LoadedSite, load_site
from fog_runtime.credentials import Credentials
from fognav import checkout, kernels, site_files, system
from fognav.credentials import own_credentials
from fognav.nodes import on_broker
from fognav.nodes.board_settings import SITE, BoardOptions, SiteOption, credentials_in, node_in, with_board_options
from fognav.operate.fog import Fog, find_fog
from fognav.operate.options import NUMBERS, FogOption, JsonOption, checked_id, numbers
from fognav.output import (
    FailedError,
    WrongUseError,
    exit_codes,
    print_answer,
    print_json,
    print_line,
    print_list,
    print_result,
)
from fognav.programs import AGGREGATOR, BROKER

node_app = typer.Typer(help="Add, watch, calibrate and simulate sensor nodes.", no_args_is_help=True)

T = TypeVar("T")
_SILENT_S = 5.0  # until somebody who watches a node that says nothing is told what to look at

NameArgument = Annotated[str, typer.Argument(metavar="NODE", help="The node's id: a to z, 0 to 9 and -.")]
BrokerOption = Annotated[
    str | None,
    typer.Option("--broker", metavar="URL", help="mqtt:// or mqtts:// address; default: that of the running system."),
]
SiteIdOption = Annotated[str | None, typer.Option("--site-id", metavar="ID", help="Default: the running system's.")]


@node_app.command(
    "add",
    context_settings=NUMBERS,
    epilog="Example: fognav node add n8 --area z1 --pose 40,26.95,1.57 --site sites/floor --wifi Lab --credentials DIR",
)
@with_board_options
def node_add(
    name: NameArgument,
    *,
    area: Annotated[str, typer.Option("--area", metavar="Z", help="The area that it watches.")],
    pose: Annotated[str, typer.Option("--pose", metavar="X,Y,THETA", help="Metres, radians; frame of the map.")],
    height: Annotated[float, typer.Option("--height", metavar="M", help="Above the floor.")] = 0.5,
    every_reading: Annotated[
        bool,
        typer.Option(
            "--every-reading/--saving-air", help="Publish every reading, as the thesis; else changes, and one a second."
        ),
    ] = False,
    board: BoardOptions,
) -> None:
    """Add a node to a site, and write what its board needs to know.

    Its range limits come from the map: the wall opposite, less 0.3 m. Calibrate it when it hangs.
    """
    with exit_codes():
        board = board.completed()
        loaded = load_site(checkout.site_folder(board.site))
        if board.target.exists():
            raise WrongUseError(
                f"{board.target} already exists: it is another node's. Move it, or name a folder with --out"
            )
        if any(node.id == name for node in loaded.site.nodes):
            raise WrongUseError(
                f"the site has a node {name} already: fognav node replace {name} makes a new board of it"
            )
        kernels.warm_cache(print_line)
        node = msgspec.structs.replace(_placed(loaded, name, area, _pose(pose), height), every_reading=every_reading)
        text = site_files.with_node(loaded, node)
        board.provision(loaded, node)
        site_files.write(loaded, text)
        board.report("added", node)


@node_app.command("replace", epilog="Example: fognav node replace n3 --site sites/floor --wifi Lab --credentials DIR")
@with_board_options
def node_replace(name: NameArgument, *, board: BoardOptions) -> None:
    """Write the settings of a new board for a node of the site, with a new password.

    With --passwords the old board's password is worth nothing from the broker's next start on.
    """
    with exit_codes():
        board = board.completed()
        loaded = load_site(checkout.site_folder(board.site))
        node = site_files.node_of(loaded, name)
        if (other := node_in(board.target)) not in (None, name):
            raise WrongUseError(f"{board.target} is that of node {other}: move it, or name a folder with --out")
        board.provision(loaded, node)
        board.report("replaced", node)


@node_app.command("list", epilog="Example: fognav node list --json")
def node_list(*, fog: FogOption = None, json: JsonOption = False) -> None:
    """List the nodes with what they say, and since when."""
    with exit_codes():
        print_list("nodes", find_fog(fog).get(AGGREGATOR, "/api/v1/nodes"), _line, json=json)


@node_app.command("watch", epilog="Example: fognav node watch n1 --count 20")
def node_watch(
    name: NameArgument,
    *,
    count: Annotated[int | None, typer.Option("--count", metavar="N", min=1, help="End after N readings.")] = None,
    broker: BrokerOption = None,
    site: SiteIdOption = None,
    fog: FogOption = None,
    json: JsonOption = False,
) -> None:
    """Show a node's readings as they come; Ctrl-C ends it.

    With --json each is one line on standard output.
    """
    with exit_codes():
        _run(_watch(_on(fog, broker, site), checked_id(name), count, json=json))


@node_app.command("calibrate", epilog="Example: fognav node calibrate n1 --site sites/floor")
def node_calibrate(  # noqa: PLR0913  # each option is an argument
    name: NameArgument,
    *,
    no_echo: Annotated[
        bool, typer.Option("--no-echo", help="Learn how the board says that nothing echoes: point it at the open.")
    ] = False,
    folder: Annotated[
        Path | None, typer.Option("--site", metavar="D", help="Folder of a site whose node gets the learned limits.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Write them even if the map's walls are elsewhere.")] = False,
    broker: BrokerOption = None,
    site: SiteIdOption = None,
    fog: FogOption = None,
    json: JsonOption = False,
) -> None:
    """Let a node measure the free corridor, and take its range limits from that. Nobody may stand in its way.

    With --site the limits, and how likely false echoes are, are written into site.toml, unless the node hears the wall
    elsewhere than the map has it: somebody may have stood there, and the node keeps its old limits, too. Without, the
    aggregator's next configuration replaces them.
    """
    with exit_codes():
        loaded = None if folder is None else load_site(checkout.site_folder(folder))
        node = None if loaded is None else site_files.node_of(loaded, name)
        url, site_id, own = _on(fog, broker, site if loaded is None else loaded.site.id)
        command = ch.LEARN_NO_ECHO if no_echo else ch.CALIBRATE
        print_line(f"node {name} measures for about {'10' if no_echo else '40'} s: keep the way in front of it free")
        learned = _run(on_broker.learn(url, site_id, checked_id(name), command, own))
        failed = [
            f"sonar {index + 1} {_RESULTS[result]}" for index, result in enumerate(learned.result) if result != "done"
        ]
        unlike: list[str] = []
        if loaded is not None and node is not None and not failed and not no_echo:
            with_limits = on_broker.with_limits(node, learned)
            unlike = [] if force else _unlike_the_map(loaded, node, learned)
            if not unlike:
                site_files.replace(loaded, with_limits)
        if json:
            print_json({"node": name, **msgspec.to_builtins(learned)})
        else:
            for index, limit in enumerate(learned.range_limit_m):
                silent = ", no echo is clear" if learned.no_echo_is_clear[index] else ""
                print_line(
                    f"sonar {index + 1}: {_RESULTS[learned.result[index]]}; blocked below {limit:.2f} m{silent}"
                    f"{on_broker.free_space(learned, index)}"
                )
        for index in range(len(learned.samples)):
            if warning := on_broker.hears_too_much(learned, index):
                print_line(warning)
        if failed:
            raise FailedError(f"node {name} keeps its old limits: {', '.join(failed)}. {on_broker.OLDER_DECLINED}")
        if unlike:
            raise FailedError(
                f"site.toml was not changed, and node {name} keeps its old limits: {'; '.join(unlike)}. Keep the way "
                "free and calibrate again; if the map or the node's pose is wrong, mend that, or take what the node "
                f"hears with --force. {on_broker.OLDER_DECLINED}"
            )
        _keep(url, site_id, name, own)
        if not no_echo and all(learned.no_echo_is_clear):
            print_line(
                f"warning: no sonar of {name} hears anything, and a dead one hears nothing either: this node will tell "
                "of what stands there, but never that nothing does. Turn one sonar to something that echoes"
            )


@node_app.command("key", epilog="Example: fognav node key update-key.pem")
def node_key(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="The private key (PEM); made if there is none.")],
) -> None:
    """Print the public half of the key that signs updates: `update_key` of a board's node.json.

    Keep the file where no server is: who has it can put any program onto the nodes.
    """
    with exit_codes():
        print_line(on_broker.make_key(file))


@node_app.command(
    "update", epilog="Example: fognav node update n1 --image firmware.bin --number 2 --key update-key.pem"
)
def node_update(  # noqa: PLR0913  # each option is an argument
    name: NameArgument,
    *,
    image: Annotated[Path, typer.Option("--image", metavar="F", help="The firmware, as PlatformIO makes it.")],
    number: Annotated[
        int, typer.Option("--number", metavar="N", min=1, max=2**31 - 1, help="Its number: above what runs.")
    ],
    key: Annotated[Path, typer.Option("--key", metavar="F", help="The private key that signs it: fognav node key.")],
    board: Annotated[Literal["d1-mini", "d1-mini32"], typer.Option("--board", help="For which it is.")] = "d1-mini32",
    address: Annotated[
        str | None, typer.Option("--url", metavar="URL", help="Where it is served; default: by this command.")
    ] = None,
    seconds: Annotated[float, typer.Option("--seconds", metavar="S", min=1.0, help="How long to wait.")] = 300.0,
    broker: BrokerOption = None,
    site: SiteIdOption = None,
    fog: FogOption = None,
    json: JsonOption = False,
) -> None:
    """Sign new firmware, offer it to a node, and wait until the node has started anew.

    The node fetches it while it goes on measuring. The offer is withdrawn at the end.
    """
    with exit_codes():
        data = on_broker.read_image(image)
        url, site_id, own = _on(fog, broker, site)
        elsewhere = None if address is None else on_broker.ServedImage(address, fetched=True)
        with nullcontext(elsewhere) if elsewhere is not None else on_broker.served(data, url) as image_at:
            try:
                offer = msgspec.convert(on_broker.signed_offer(data, number, board, key, image_at.url), NodeUpdate)
            except msgspec.ValidationError as error:
                raise WrongUseError(f"the offer is not valid: {error}") from error
            reading = _run(on_broker.update(url, site_id, checked_id(name), offer, own, seconds=seconds))
        if not image_at.fetched:
            raise FailedError(f"node {name} has restarted without fetching the image: look at its power, and try again")
        values = {"node": name, "number": number, "sha256": offer.sha256, "fw": reading.fw, "boot": reading.boot}
        line = f"node {name} has started anew, with firmware {reading.fw or 'that does not tell its name'}"
        print_result(values, line, json=json, write=print_line)


@node_app.command(
    "sim",
    context_settings=NUMBERS,
    epilog="Example: fognav node sim n1 --site estig --broker mqtt://localhost --person 40.0,28.4",
)
def node_sim(  # noqa: PLR0913  # each option is an argument
    name: NameArgument,
    *,
    person: Annotated[
        list[str] | None, typer.Option("--person", metavar="X,Y", help="Somebody stands there; may be repeated.")
    ] = None,
    seconds: Annotated[
        float | None, typer.Option("--seconds", metavar="S", min=0.1, help="End after this time.")
    ] = None,
    every_reading: Annotated[
        bool | None,
        typer.Option("--every-reading/--saving-air", help="What it publishes; default: as the site's file says."),
    ] = None,
    board: Annotated[
        Path | None, typer.Option("--board", metavar="DIR", help="Folder of its board's settings, to log in by them.")
    ] = None,
    site: SiteOption = SITE,
    broker: BrokerOption = None,
    fog: FogOption = None,
) -> None:
    """Run one node of a site with the firmware's own code, on a real broker and a simulated floor; Ctrl-C ends it.

    A broker with passwords lets it in by its board's settings (--board), or by the credentials that the environment
    names.
    """
    from fognav_sim.live import StillFloor, VirtualNode, run_nodes  # noqa: PLC0415  # the simulator's imports are slow
    from fognav_sim.nodes import make_nodes  # noqa: PLC0415  # same

    with exit_codes():
        loaded = load_site(checkout.site_folder(site))
        node = site_files.node_of(loaded, name)
        if every_reading is not None:
            node = msgspec.structs.replace(node, every_reading=every_reading)
        persons = [numbers(text, (2,), "X,Y") for text in person or ()]
        own = own_credentials() if board is None else credentials_in(board, name)
        url, _, _ = _on(fog, broker, loaded.site.id)
        kernels.warm_cache(print_line)
        system.prepare_node_code(print_line)
        clock = SystemClock()
        try:
            floor = StillFloor(loaded, [(x, y) for x, y in persons], clock)
        except ValueError as error:
            raise WrongUseError(f"--person {error}") from error
        (sonars,) = make_nodes([node], int(time.time()), clock.now())
        _run(_bounded(run_nodes([VirtualNode(sonars, floor, url, clock, loaded.site.id, own)], clock), seconds))


_RESULTS: Final = {
    "done": "learned",
    "stuck": "does not answer: check its supply (5 V), trigger and echo wires",
    "unsteady": "measured something that moved: let nobody stand there",
    "too_near": "looks at something too near: turn the node",
}


def _keep(url: str, site: str, name: str, own: Credentials) -> None:
    """Let a node go by what it learned from now on; it does not before, so that what is declined never counts.

    Firmware of before that command has gone by it since it learned it.
    """
    try:
        _run(on_broker.learn(url, site, name, ch.KEEP, own))
    except on_broker.OlderFirmwareError:
        print_line(
            f"warning: node {name} has older firmware: what it learned counts already, and would if this command had "
            "declined it. Update it (fognav node update)"
        )
    except FailedError as error:
        raise FailedError(f"{error}. It may still go by its old limits: calibrate again") from error


async def _watch(on: tuple[str, str, Credentials], name: str, count: int | None, *, json: bool) -> None:
    seen, (url, site, own) = 0, on
    nothing = f"nothing was heard from {name} yet: is that its id (fognav node list), and has it power and Wi-Fi?"
    hint = asyncio.get_running_loop().call_later(_SILENT_S, print_line, nothing)
    async for reading in on_broker.readings(url, site, name, own):
        hint.cancel()
        if json:
            values = {"state": reading} if isinstance(reading, str) else msgspec.to_builtins(reading)
            typer.echo(msgspec.json.encode(values).decode())
        else:
            print_answer(f"{time.strftime('%H:%M:%S')} {reading if isinstance(reading, str) else _reading(reading)}")
        if isinstance(reading, NodeReading):
            seen += 1
            if seen == count:
                return


def _reading(reading: NodeReading) -> str:
    ranges = ", ".join("no echo" if value is None else f"{value:.2f} m" for value in reading.range_m)
    return f"{reading.state:8s} {ranges}"


async def _bounded(work: Coroutine[Any, Any, None], seconds: float | None) -> None:
    try:
        async with asyncio.timeout(seconds):
            await work
    except TimeoutError:
        if seconds is None:
            raise


def _run(work: Coroutine[Any, Any, T]) -> T:
    try:
        return asyncio.run(work)
    except KeyboardInterrupt:
        raise typer.Exit(0) from None


def _on(fog: str | None, broker: str | None, site: str | None) -> tuple[str, str, Credentials]:
    """Return the broker's address, the site's id and the caller's credentials.

    They are those that are given, else those of the running system.
    """
    if broker is not None and site is not None:
        return broker, site, own_credentials()
    found: Fog = find_fog(fog)
    url = broker or found.system.urls.get(BROKER)
    if url is None:
        raise WrongUseError(
            f"the broker of {found.system.name} is not known: name it with --broker mqtts://USER:PASSWORD@HOST"
        )
    return url, site or found.site, found.credentials


def _pose(text: str) -> tuple[float, float, float]:
    x, y, theta = numbers(text, (3,), "X,Y,THETA")
    if abs(theta) > math.tau:
        raise WrongUseError(
            f"--pose {text}: its direction is in radians, and {theta:g} is more than a turn. {theta:g} degrees are "
            f"{math.remainder(math.radians(theta), math.tau):.4f}"
        )
    return x, y, theta


def _placed(loaded: LoadedSite, name: str, area: str, pose: tuple[float, float, float], height: float) -> NodeSite:
    from fognav.nodes.placing import (  # noqa: PLC0415  # kernels are slow
        PlacingError,
        bounded,
        check_sees,
        heading_that_hears,
        hears,
        sonar_limits,
    )
    from fognav_sim.floor import Floor  # noqa: PLC0415  # as above

    areas = {known.id: known for known in loaded.site.areas}
    if area not in areas:
        raise WrongUseError(f"the site has no area {area!r}: it has {', '.join(areas) or 'none'}")
    x, y, theta = pose
    try:
        members = {
            "id": name,
            "area": area,
            "x": x,
            "y": y,
            "theta": round(math.remainder(theta, math.tau), 4),
            "height": height,
            "sonars": msgspec.to_builtins(sonar_limits(loaded.map, pose)),
        }
        node = msgspec.convert(members, NodeSite)
        check_sees(node, areas[area], loaded.map)
        node = bounded(Floor(loaded.map.geometry, loaded.map.cells), node)
    except (PlacingError, msgspec.ValidationError) as error:
        raise WrongUseError(f"node {name}: {error}") from error
    if not hears(node):
        heading = heading_that_hears(loaded.map, node, areas[area])
        remedy = (
            "move it opposite a wall" if heading is None else f"with --pose {x:g},{y:g},{heading:g} it hears a wall"
        )
        print_line(
            f"warning: on the map no sonar of {name} hears a wall, and a dead one hears nothing either: it will tell "
            f"of what stands there, but never that nothing does, and its area stays unknown: {remedy}"
        )
    return node


def _unlike_the_map(loaded: LoadedSite, node: NodeSite, learned: NodeCalibration) -> list[str]:
    from fognav.nodes.placing import PlacingError, unlike_the_map  # noqa: PLC0415  # kernels are slow

    try:
        return unlike_the_map(loaded.map, node, learned)
    except PlacingError as error:
        return [f"node {node.id}: {error}"]


def _line(node: dict[str, Any]) -> str:
    age = "never heard" if node["age_s"] is None else f"{node['age_s']:.1f} s ago"
    reason = f" ({node['reason']})" if node["reason"] else ""
    return f"{node['id']}: area {node['area']}, {node['state']}{reason}, {age}, {node['received']} readings"
