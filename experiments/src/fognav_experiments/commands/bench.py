"""`fognav bench`: measure parts of the system on this machine. Long, because it lists the options of all benchmarks."""

from __future__ import annotations

import asyncio
import os
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated

import typer
from msgspec import to_builtins
from rich.progress import Progress

from fog_contracts.messages import ProfileName  # noqa: TC001  # Typer reads annotations at run time
from fognav import checkout, kernels
from fognav.commands.installed import MEASURE
from fognav.operate.options import JsonOption  # noqa: TC001  # same
from fognav.output import NOT_TRUE, WrongUseError, check_writable, console, exit_codes, print_json, print_line
from fognav_experiments import machine
from fognav_experiments.commands import logs

if TYPE_CHECKING:
    from collections.abc import Mapping

bench_app = typer.Typer(help="Measure parts of the system on this machine.", no_args_is_help=True)


def add_to(app: typer.Typer) -> None:
    """Add the command to `fognav`."""
    logs.add_bench(bench_app)
    app.add_typer(bench_app, name="bench", rich_help_panel=MEASURE)


def _show(bench: str, asked: Mapping[str, object], figures: Mapping[str, object], *, json: bool) -> None:
    """Write what was asked and measured: for people, or as the JSON object of a benchmark."""
    if json:
        print_json({"bench": bench, **asked, **figures, **machine.describe()})
        return
    shown = {**asked, **figures}
    width = max(map(len, shown))
    for name, value in shown.items():
        print_line(f"{name:{width}} {value}")


@bench_app.command("fleet", epilog="Example: fognav bench fleet --robots 50 --goals 50 --zones 300 --json")
def fleet_command(  # noqa: PLR0913  # the options of a command
    *,
    robots: Annotated[int, typer.Option("--robots", metavar="N", min=1, max=500, help="Robots with a goal.")] = 50,
    goals: Annotated[int, typer.Option("--goals", metavar="G", min=1, max=500, help="Different goals.")] = 50,
    zones: Annotated[int, typer.Option("--zones", metavar="Z", min=0, max=5000, help="No-go zones.")] = 300,
    trials: Annotated[int, typer.Option("--trials", metavar="T", min=1, help="Hazards of each kind.")] = 5,
    seed: Annotated[int, typer.Option("--seed", metavar="N", min=0, help="Seed of floor, places and zones.")] = 1,
    live: Annotated[
        bool,
        typer.Option("--live", help="Measure a planner's process, with a router, a store and robots' subscribers."),
    ] = False,
    json: JsonOption = False,
) -> None:
    """Measure the planner with many robots.

    One hazard lies across all paths, then one cuts all goals off, then they are reachable again. The map is an office
    of 100 x 60 m at 5 cm. Times are in ms, from a change of the map to each robot's path or refusal: within the
    planner's core, or, with --live, from its publication to the robot's subscriber.
    """
    import numpy as np  # noqa: PLC0415  # keeps the other commands fast

    from fognav_experiments.bench import fleet_live  # noqa: PLC0415  # same
    from fognav_experiments.bench.common import make_office  # noqa: PLC0415  # same
    from fognav_experiments.bench.fleet import Fleet, FleetMap, measure, place_fleet  # noqa: PLC0415  # same

    kernels.warm_cache(print_line)
    rng = np.random.default_rng(seed)
    with exit_codes(), Progress(console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task("planning the first paths", total=trials)
        map_ = FleetMap(make_office(seed=seed), zones, rng)

        def show(done: int, _total: int) -> None:
            progress.update(task, completed=done, description="hazards")

        if live:
            fleet = place_fleet(map_, robots, goals, rng)
            figures = asyncio.run(fleet_live.measure(map_, fleet, trials, show))
        else:
            figures = measure(map_, Fleet(map_, robots, goals, rng), trials, show)
    asked = {"robots": robots, "goals": goals, "zones": zones, "trials": trials, "seed": seed, "live": live}
    _show("fleet", asked, figures, json=json)


@bench_app.command("floor", epilog="Example: fognav bench floor --width 500 --height 500 --json")
def floor_command(
    *,
    width: Annotated[float, typer.Option("--width", metavar="M", min=40.0, max=2000.0, help="Width (m).")] = 500.0,
    height: Annotated[float, typer.Option("--height", metavar="M", min=30.0, max=2000.0, help="Height (m).")] = 500.0,
    json: JsonOption = False,
) -> None:
    """Measure a map-service and a planner on a large floor, at 5 cm per cell.

    Real processes: until each is ready, their memory, a snapshot of the map, a path across the whole floor, and another
    one after a zone closed it. By default the largest floor that there may be, 10,000 x 10,000 cells; it takes some
    minutes, and memory of several GB.
    """
    from fognav_experiments.bench import floor  # noqa: PLC0415  # keeps the other commands fast

    kernels.warm_cache(print_line)
    with exit_codes(), TemporaryDirectory(prefix="fognav-") as folder:
        cells = floor.prepare(Path(folder), width, height)
        figures = asyncio.run(floor.measure(Path(folder), cells, width, height, print_line))
    asked = {"width": width, "height": height}
    _show("floor", asked, figures, json=json)


@bench_app.command("floors", epilog="Example: fognav bench floors --floors 1 --floors 2 --floors 5 --json")
def floors_command(
    *,
    counts: Annotated[
        list[int] | None, typer.Option("--floors", metavar="N", min=1, max=50, help="How many; may be repeated.")
    ] = None,
    robots: Annotated[int, typer.Option("--robots", metavar="N", min=1, max=20, help="Of each floor.")] = 5,
    nodes: Annotated[int, typer.Option("--nodes", metavar="N", min=1, max=200, help="Of each floor.")] = 25,
    seconds: Annotated[float, typer.Option("--seconds", metavar="S", min=5.0, help="How long to measure.")] = 60.0,
    stops: Annotated[
        int, typer.Option("--stops", metavar="N", min=0, max=50, help="Press the stop of all floors so often, instead.")
    ] = 0,
    json: JsonOption = False,
) -> None:
    """Measure what floors cost this machine, each with servers and services of its own.

    Robots and nodes are played by one process a floor, which does not count. Memory (MB) and processor time (% of a
    core) are those of all floors together, by program; the model is the line through the least and the largest count.
    With --stops two floors have a whole simulated robot each, which drive; times run from the request to
    the console-service of one floor until the bases of both robots are told to stand, and until both do.
    """
    from fognav_experiments.bench import floors  # noqa: PLC0415  # keeps the other commands fast

    kernels.warm_cache(print_line)
    with exit_codes(), TemporaryDirectory(prefix="fognav-") as folder:
        traffic = floors.Traffic(robots, nodes)
        if stops:
            figures = asyncio.run(floors.stops(checkout.root() / "sites", Path(folder), stops, print_line))
        else:
            figures = asyncio.run(floors.measure(Path(folder), counts or [1, 2], traffic, seconds, print_line))
    asked = {"stops": stops} if stops else {"robots": robots, "nodes": nodes, "seconds": seconds}
    _show("floors", asked, figures, json=json)


@bench_app.command("room", epilog="Example: fognav bench room --robots 10 --seeds 200 --floor estig --json")
def room_command(  # noqa: PLR0913  # its options
    *,
    robots: Annotated[int, typer.Option("--robots", metavar="N", min=1, max=50, help="Robots on the floor.")] = 4,
    seeds: Annotated[int, typer.Option("--seeds", metavar="N", min=1, help="Runs, each with another seed.")] = 5,
    first: Annotated[int, typer.Option("--first", metavar="N", min=0, help="The first seed.")] = 1,
    seconds: Annotated[int, typer.Option("--seconds", metavar="S", min=10, help="Simulated time of a run.")] = 300,
    floor: Annotated[str, typer.Option("--floor", help="aisles, narrow (aisles for one robot) or estig.")] = "aisles",
    map_file: Annotated[
        Path | None, typer.Option("--map", metavar="FILE", help="A map_server YAML, instead of such a floor.")
    ] = None,
    blocks: Annotated[
        bool, typer.Option("--blocks", help="Close watched areas; each seed with nodes, and with lidars alone.")
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="Keep and continue the runs with --blocks, and a report."),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Measure how robots make room for one another.

    Blind robots get one goal after the other at random, on six aisles of 27 m (1.8 m wide, or 1.2 m), on a site's
    floor or a map's, while hazards come and go. Only the planner's leases keep them apart; contact is computed exactly.
    With --blocks the hazards close watched areas from wall to wall, for 1 to 5 minutes. Robots have lidars then.
    """
    if blocks:
        _blocks(floor, robots, range(first, first + seeds), seconds, out, json=json)
        return
    from fog_runtime.configuration.maps import load_map  # noqa: PLC0415  # keeps the other commands fast
    from fognav_experiments.bench import room  # noqa: PLC0415  # same

    kernels.warm_cache(print_line)
    with exit_codes(), Progress(console=console, disable=not console.is_terminal) as progress:
        try:
            map_ = room.floor_named(floor, checkout.root() / "sites") if map_file is None else load_map(map_file)
        except ValueError as error:
            raise WrongUseError(str(error)) from error
        task = progress.add_task("driving", total=seeds)
        runs = []
        for seed in range(first, first + seeds):
            runs.append(room.play(map_, robots, seed, float(seconds)))
            progress.advance(task)
    name = floor if map_file is None else str(map_file)
    asked = {"floor": name, "robots": robots, "seeds": seeds, "first": first, "seconds": seconds}
    _show("room", asked, room.summary(runs), json=json)


def _blocks(floor: str, robots: int, seeds: range, seconds: int, out: Path | None, *, json: bool) -> None:
    """Drive among blocks, with nodes and with lidars alone."""
    from fognav_experiments.bench import room, room_blocks  # noqa: PLC0415  # keeps the other commands fast

    kernels.warm_cache(print_line)
    with exit_codes():
        try:
            runs = []
            sites = checkout.root() / "sites"
            for run in room_blocks.play_all(floor, sites, robots, seeds, float(seconds), out, checkout.revision()):
                runs.append(run)
                print_line(f"{floor}, {robots} robots, seed {run.run.seed}, {run.eyes}: {run.per_hour:.1f} missions/h")
        except ValueError as error:
            raise WrongUseError(str(error)) from error
        if out is not None:
            room_blocks.publish(room_blocks.read(out), out)
    of = {eyes: [run for run in runs if run.eyes == eyes] for eyes in room_blocks.EYES}
    figures: dict[str, object] = {}
    for eyes, found in of.items():
        entered = {"in_blocks": sum(run.entered for run in found)}
        figures[eyes] = room.summary([run.run for run in found]) | entered
    _show("room", {"floor": floor, "robots": robots, "seeds": len(seeds), "seconds": seconds}, figures, json=json)


@bench_app.command("costmap", epilog="Example: fognav bench costmap --zones 5000 --json")
def costmap_command(
    *,
    zones: Annotated[int, typer.Option("--zones", metavar="Z", min=1, max=5000, help="Zones of 5 x 5 m.")] = 5000,
    repeats: Annotated[int, typer.Option("--repeats", metavar="N", min=1, help="Repetitions of each figure.")] = 5,
    seed: Annotated[int, typer.Option("--seed", metavar="N", min=0, help="Seed of the floor.")] = 1,
    json: JsonOption = False,
) -> None:
    """Measure the map-service's core.

    Full updates and a change of 2 x 2 m, the legal zones that cost most, the start with many zones, a snapshot. The map
    is an office of 100 x 60 m at 5 cm. Times are in ms.
    """
    from fognav_experiments.bench import cores  # noqa: PLC0415  # keeps the other commands fast
    from fognav_experiments.bench.common import make_office  # noqa: PLC0415  # same

    kernels.warm_cache(print_line)
    figures = cores.measure_costmap(make_office(seed=seed), zones, repeats)
    _show("costmap", {"repeats": repeats, "seed": seed}, figures, json=json)


@bench_app.command("robot", epilog="Example: fognav bench robot --seconds 30 --cpu-quota 0.2 --json")
def robot_command(  # noqa: PLR0913  # each option is an argument
    *,
    seconds: Annotated[
        float, typer.Option("--seconds", metavar="S", min=1.0, max=120.0, help="Length of each measurement.")
    ] = 30.0,
    cpu_quota: Annotated[
        float | None,
        typer.Option("--cpu-quota", metavar="SHARE", min=0.01, max=4.0, help="Limit the robot to a share of a core."),
    ] = None,
    profile: Annotated[
        ProfileName, typer.Option("--profile", metavar="P", help="fog, full or default: who plans.")
    ] = "fog",
    width: Annotated[float, typer.Option("--width", metavar="M", min=25.0, max=500.0, help="Of the floor.")] = 100.0,
    height: Annotated[float, typer.Option("--height", metavar="M", min=15.0, max=500.0, help="Of the floor.")] = 57.0,
    changes: Annotated[
        float, typer.Option("--changes", metavar="N", min=0.0, max=600.0, help="Corridors closed a minute.")
    ] = 0.0,
    json: JsonOption = False,
) -> None:
    """Measure what the robot's processes cost.

    Agent, guardian and watchdog, standing by and driving, by default on a map of 2000 x 1140 cells of 5 cm. Fog,
    simulator and emulated devices are processes of their own, which do not count. CPU is in percent of one core.
    """
    from fognav_experiments.bench import robot  # noqa: PLC0415  # keeps the other commands fast

    kernels.warm_cache(print_line)
    with exit_codes():
        conditions = robot.Conditions(profile, (width, height), changes)
        figures = robot.measure(seconds, cpu_quota, print_line, conditions)
    asked = {"seconds": seconds, "cpu_quota": cpu_quota, **conditions._asdict()}
    _show("robot", asked, figures, json=json)


@bench_app.command("air", epilog="Example: fognav bench air --seconds 60 --json")
def air_command(
    *,
    seconds: Annotated[float, typer.Option("--seconds", metavar="S", min=1.0, help="Length of each phase.")] = 30.0,
    json: JsonOption = False,
) -> None:
    """Estimate how much of a Wi-Fi channel nodes and robots occupy.

    A node and a robot are measured, as real processes with TLS, and what 7, 50 and 500 nodes and 5 driving robots need
    follows by the times of frames at 2.4 GHz: in percent of a channel, near its access point or far from it.
    """
    from fognav_experiments.bench import air  # noqa: PLC0415  # keeps the other commands fast

    kernels.warm_cache(print_line)
    with exit_codes():
        figures = air.measure(seconds, print_line)
    _show("air", {"seconds": seconds}, figures, json=json)


@bench_app.command("rest", epilog="Example: fognav bench rest --clients 32 --seconds 60 --json")
def rest_command(
    *,
    clients: Annotated[int, typer.Option("--clients", metavar="N", min=1, max=128, help="Clients at once.")] = 32,
    seconds: Annotated[float, typer.Option("--seconds", metavar="S", min=1.0, help="How long they ask.")] = 30.0,
    zones: Annotated[int, typer.Option("--zones", metavar="Z", min=0, max=4900, help="Zones of 5 x 5 m.")] = 4900,
    json: JsonOption = False,
) -> None:
    """Measure how steady the map's heartbeat is under load, and how long zones take without any.

    Clients send a map-service the costliest zones, read all zones and pictures, send invalid and oversized bodies, or
    send and read slowly; another process times the heartbeat (100 ms), without clients (`idle_`) and with them.
    """
    from fognav_experiments.bench import rest  # noqa: PLC0415  # keeps the other commands fast
    from fognav_experiments.bench.common import make_office, write_site  # noqa: PLC0415  # same

    kernels.warm_cache(print_line)
    floor = make_office()
    with exit_codes(), TemporaryDirectory(prefix="fognav-") as folder:
        write_site(Path(folder), floor)
        figures = asyncio.run(rest.measure(Path(folder), floor, zones=zones, clients=clients, seconds=seconds))
    asked = {"clients": clients, "seconds": seconds, "zones": zones}
    _show("rest", asked, figures, json=json)


@bench_app.command("console", epilog="Example: fognav bench console --readers 1000 --seconds 20 --json")
def console_command(
    *,
    readers: Annotated[int, typer.Option("--readers", metavar="N", min=1, max=1024, help="Readers of events.")] = 1000,
    floors: Annotated[
        list[int] | None,
        typer.Option("--floors", metavar="N", min=1, max=1000, help="List so many floors, instead; may be repeated."),
    ] = None,
    robots: Annotated[int, typer.Option("--robots", metavar="N", min=1, max=100, help="Robots that drive.")] = 10,
    seconds: Annotated[float, typer.Option("--seconds", metavar="S", min=1.0, help="Of each measurement.")] = 20.0,
    json: JsonOption = False,
) -> None:
    """Measure the console's events with many readers.

    Robots send poses ten times a second, and hazards come and go. Times are in ms, from the publication of a pose, or
    the confirmation of a hazard, to one of ten readers among all; processor time and memory are the console-service's,
    the heartbeat (100 ms) is the map-service's, without readers (`idle_`) and with them.
    With --floors its list has so many other floors; up to 100 of them ask it once a second. Unencrypted. How old (s) is
    what it knows of them, and how long (ms) its answers take.
    """
    from fognav_experiments.bench import console as events  # noqa: PLC0415  # keeps the other commands fast

    kernels.warm_cache(print_line)
    with exit_codes(), TemporaryDirectory(prefix="fognav-") as folder:
        if floors:
            counts = []
            for count in floors:
                (at := Path(folder) / str(count)).mkdir()
                counts.append(asyncio.run(events.measure_floors(at, count, seconds, print_line)))
            figures, asked = {"counts": counts}, {"seconds": seconds}
        else:
            figures = asyncio.run(
                events.measure(Path(folder), readers=readers, robots=robots, seconds=seconds, on_phase=print_line)
            )
            asked = {"readers": readers, "robots": robots, "seconds": seconds}
    _show("console", asked, figures, json=json)


@bench_app.command("localization", epilog="Example: fognav bench localization --json")
def localization_command(
    *,
    particles: Annotated[int, typer.Option("--particles", metavar="N", min=10, max=50_000, help="Particles.")] = 2000,
    beams: Annotated[int, typer.Option("--beams", metavar="N", min=10, max=1000, help="Beams of an update.")] = 60,
    repeats: Annotated[int, typer.Option("--repeats", metavar="N", min=1, help="Repetitions of each figure.")] = 200,
    seed: Annotated[int, typer.Option("--seed", metavar="N", min=0, help="Seed of floor and particles.")] = 1,
    json: JsonOption = False,
) -> None:
    """Measure the localization.

    One cycle of the particle filter (move, weight, cluster, resample) beside the same with plainly written scores, the
    match of a scan, and the search of a whole office of 100 x 60 m at 5 cm. Times are in ms.
    """
    from fognav_experiments.bench import cores  # noqa: PLC0415  # keeps the other commands fast
    from fognav_experiments.bench.common import make_office  # noqa: PLC0415  # same

    kernels.warm_cache(print_line)
    figures = cores.measure_localization(make_office(seed=seed), particles, beams, repeats, seed)
    asked = {"particles": particles, "beams": beams, "repeats": repeats, "seed": seed}
    _show("localization", asked, figures, json=json)


@bench_app.command("planner", epilog="Example: fognav bench planner --map office.yaml --queries 30 --json")
def planner_command(
    *,
    map_file: Annotated[
        Path | None,
        typer.Option("--map", metavar="FILE", help="A map_server YAML, or MovingAI's `.map`; else an office."),
    ] = None,
    scenario: Annotated[
        Path | None, typer.Option("--scen", metavar="FILE", help="MovingAI's queries with their shortest lengths.")
    ] = None,
    queries: Annotated[int, typer.Option("--queries", metavar="N", min=1, max=10_000, help="How many.")] = 30,
    seed: Annotated[int, typer.Option("--seed", metavar="N", min=0, help="Seed of office, queries and hazards.")] = 1,
    json: JsonOption = False,
) -> None:
    """Measure path searches: from scratch, and again after a hazard of 2 x 2 m on the path.

    The office has 100 x 60 m at 5 cm; without a scenario, queries are long ones. `optimal` counts the queries that cost
    what an unguided and a Dijkstra search find, and have the published length; `replans_optimal` the replans that cost
    what a search from scratch finds; `replans_closed` those that no path is left for. Times are in ms of the processor,
    with cold caches; `field_median_ms` is that of the goal's field, once per goal. Beside them stand pyastar2d, tcod
    and scikit-image, if they are installed, and by how much paths cost more than along the gradient of NavFn's
    potential.
    """
    import numpy as np  # noqa: PLC0415  # keeps the other commands fast

    from fog_runtime.configuration.maps import MapFileError, MapTextError  # noqa: PLC0415  # same
    from fognav_experiments.bench import planner  # noqa: PLC0415  # same

    kernels.warm_cache(print_line)
    rng = np.random.default_rng(seed)
    with exit_codes(), Progress(console=console, disable=not console.is_terminal) as progress:
        try:
            floor = planner.load_floor(map_file, seed)
            asked = planner.read_scenario(scenario, queries) if scenario else None
        except (MapTextError, MapFileError, OSError) as error:
            raise WrongUseError(str(error)) from error
        asked = asked or planner.long_queries(floor.costmap, queries, rng)
        task = progress.add_task("queries", total=len(asked))
        figures = planner.measure(floor, asked, rng, lambda done: progress.update(task, completed=done))
    height, width = floor.costmap.shape
    what = {"map": "office" if map_file is None else map_file.name, "width": width, "height": height, "seed": seed}
    _show("planner", what, figures, json=json)


@bench_app.command("calibration", epilog="Example: fognav bench calibration --seeds 20 --json")
def calibration_command(
    *,
    seeds: Annotated[int, typer.Option("--seeds", metavar="N", min=1, help="Robots, each with its own room.")] = 20,
    json: JsonOption = False,
) -> None:
    """Calibrate simulated robots whose wheels, axle and lidar are up to 15 % wrong, and compare with the truth."""
    from fognav_experiments.bench.calibration import measure  # noqa: PLC0415  # same

    kernels.warm_cache(print_line)
    with exit_codes(), Progress(console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task("calibrating", total=seeds)
        figures = measure(seeds, lambda done: progress.update(task, completed=done))
    _show("calibration", {}, figures, json=json)


@bench_app.command("dwa", epilog="Example: fognav bench dwa --repeats 2000 --json")
def dwa_command(
    *,
    repeats: Annotated[int, typer.Option("--repeats", metavar="N", min=1, help="Repetitions of each figure.")] = 1000,
    json: JsonOption = False,
) -> None:
    """Measure a robot's decision among 25 x 35 arcs.

    The distances around it and the choice, for a round body and a rectangle in a corridor, and a whole decision. Times
    are in ms; `peer_ratio` is by 1.75 ms, which ROS 1's local planner took for as many arcs on another x86 server.
    """
    from fognav_experiments.bench import cores  # noqa: PLC0415  # keeps the other commands fast

    kernels.warm_cache(print_line)
    figures = cores.measure_dwa(repeats)
    _show("dwa", {"repeats": repeats}, figures, json=json)


@bench_app.command("pipeline", epilog="Example: fognav bench pipeline --nodes 500 --rate 20 --seconds 30 --json")
def pipeline_command(  # noqa: PLR0913  # the options of the command
    *,
    nodes: Annotated[int, typer.Option("--nodes", metavar="N", min=1, max=2000, help="Nodes that publish.")] = 500,
    rate: Annotated[float, typer.Option("--rate", metavar="HZ", min=1.0, max=50.0, help="Readings per second.")] = 20.0,
    robots: Annotated[int, typer.Option("--robots", metavar="N", min=0, max=200, help="Robots with poses.")] = 50,
    seconds: Annotated[float, typer.Option("--seconds", metavar="S", min=4.0, help="How long they publish.")] = 30.0,
    width: Annotated[float, typer.Option("--width", metavar="M", min=20.0, help="Width of the floor.")] = 60.0,
    height: Annotated[float, typer.Option("--height", metavar="M", min=20.0, help="Height of the floor.")] = 40.0,
    ros2: Annotated[
        int | None,
        typer.Option("--ros2", metavar="N", min=0, max=20, help="Bridge to ROS 2, N of whose peers stopped reading."),
    ] = None,
    wire: Annotated[str, typer.Option("--wire", metavar="W", help="Of that bridge: zenoh, or dds (N: 0).")] = "zenoh",
    json: JsonOption = False,
) -> None:
    """Measure the way from readings to the map.

    Broker, aggregator and map-service are real processes with TLS and passwords; so is the generator of the load.
    Readings that the aggregator did not get are lost; times are in ms, from the confirmation of a hazard to the map's
    delta and, with --ros2, to the keepout mask at a peer of the bridge.
    """
    from fognav_experiments.bench import pipeline  # noqa: PLC0415  # keeps the other commands fast

    kernels.warm_cache(print_line)
    with exit_codes(), TemporaryDirectory(prefix="fognav-") as folder:
        if wire != "zenoh" and (wire, ros2) != ("dds", 0):
            raise WrongUseError(f"--wire {wire}: it is zenoh, or dds, which has --ros2 0")
        figures = asyncio.run(
            pipeline.measure(
                Path(folder), nodes=nodes, rate=rate, robots=robots, seconds=seconds, size=(width, height),
                stopped_peers=ros2, wire="dds" if wire == "dds" else "zenoh", on_phase=print_line,
            )
        )  # fmt: skip
    asked = {"nodes": nodes, "rate": rate, "robots": robots, "seconds": seconds, "width": width, "height": height}
    _show("pipeline", asked, figures, json=json)


@bench_app.command("warning", epilog="Example: fognav bench warning --warnings 50 --json")
def warning_command(  # noqa: PLR0913  # the options of the command
    *,
    warnings: Annotated[int, typer.Option("--warnings", metavar="N", min=1, help="Obstacles for each rule.")] = 50,
    rule: Annotated[
        list[str] | None, typer.Option("--rule", metavar="R", help="A debounce rule; may be repeated. Default: two.")
    ] = None,
    site: Annotated[Path, typer.Option("--site", metavar="D", help="Folder of the site.")] = Path("estig"),
    false_echoes: Annotated[
        float | None,
        typer.Option("--false-echoes", metavar="N", min=0.0, max=50.0, help="Invent echoes in N % of measurements."),
    ] = None,
    hours: Annotated[
        float, typer.Option("--hours", metavar="H", min=0.01, help="Simulated hours with nothing but false echoes.")
    ] = 2.0,
    leader: Annotated[
        list[str] | None,
        typer.Option("--leader", metavar="F", help="Let the first of two planners be slow, lossy or dead."),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", metavar="N", min=0, help="Seed of the obstacles.")] = 1,
    json: JsonOption = False,
) -> None:
    """Measure a warning: from an obstacle's first echo at a node to the path that a robot receives around it.

    The whole fog runs as real processes with TLS and passwords, the nodes run the firmware's code, with an MQTT
    connection each, and the robot is a stand-in with a goal. Obstacles close an area on its way, one after another.
    Times are in ms.

    With --false-echoes the nodes and the aggregator's core run in simulated time instead, whatever the machine's load:
    all sonars hear what is not there, their nodes are calibrated in that, and false alarms are counted, too.

    With --leader two planners run, and the one that leads becomes slow (answers 500 ms later), lossy (half of its
    packets) or dead. Obstacles come before (the control), during, and after that.
    """
    from fog_runtime.configuration.site import load_site  # noqa: PLC0415  # keeps the other commands fast
    from fognav_experiments.bench import false_echoes as noise  # noqa: PLC0415  # same
    from fognav_experiments.bench import second_planner, warning  # noqa: PLC0415  # same

    kernels.warm_cache(print_line)
    rows = []
    with exit_codes(), Progress(console=console, disable=not console.is_terminal) as progress:
        loaded = load_site(checkout.site_folder(site))
        for fault in map(second_planner.fault, leader or ()):
            advance = partial(progress.advance, progress.add_task(fault, total=warnings))
            rows += asyncio.run(second_planner.measure(loaded, fault, warnings, seed, advance))
        for each in rule or ([] if leader else ["evidence", "consecutive"]):
            task = progress.add_task(each, total=warnings)
            advance = partial(progress.advance, task)
            if false_echoes is not None:
                rows.append(noise.measure(loaded, each, noise.Asked(false_echoes / 100.0, hours, warnings, seed)))
                progress.update(task, completed=warnings)
                continue
            rows.append(asyncio.run(warning.measure(loaded, each, warnings, seed, advance)))
    if json:
        print_json({"bench": "warning", "warnings": warnings, "seed": seed, "rows": rows, **machine.describe()})
        return
    for row in rows:
        for name, value in row.items():
            console.print(f"{name:28} {value}", markup=False)


@bench_app.command("move-base", epilog="Example: fognav bench move-base --ros ~/ws/devel --rates default --json")
def move_base_command(  # noqa: PLR0913  # the options of the command
    *,
    ros: Annotated[
        Path, typer.Option("--ros", metavar="D", help="Folder `devel` in which ROS 1's navigation was built.")
    ],
    rates: Annotated[
        list[str] | None,
        typer.Option("--rates", metavar="R", help="The thesis's default or full; may be repeated. Default: both."),
    ] = None,
    run: Annotated[int, typer.Option("--run", metavar="N", min=1, help="Which draw of the experiment.")] = 1,
    blocked: Annotated[bool, typer.Option("--blocked/--free", help="Whether the drawn barrier is placed.")] = True,
    speed: Annotated[float, typer.Option("--speed", metavar="F", min=0.1, help="How fast ROS's clock runs.")] = 1.0,
    site: Annotated[Path, typer.Option("--site", metavar="D", help="Folder of the site.")] = Path("estig"),
    seed: Annotated[int, typer.Option("--seed", metavar="N", min=0, help="Seed of the experiment's draws.")] = 1,
    json: JsonOption = False,
) -> None:
    """Let ROS 1's move_base and amcl, which you built, drive the simulated robot over the experiment's routes.

    The routes, starts and barriers are those of `fognav experiment`, whose draws have the same numbers. No sensor node
    tells the robot anything. docs/benchmarks.md says how to build the programs, and what they took.
    """
    from fog_runtime.configuration.site import load_site  # noqa: PLC0415  # keeps the other commands fast
    from fognav_experiments.comparison import move_base  # noqa: PLC0415  # same
    from fognav_experiments.comparison.drives import draw  # noqa: PLC0415  # same
    from fognav_experiments.comparison.runner import SpecError, read_spec  # noqa: PLC0415  # same

    drives = []
    with exit_codes():
        folder = checkout.site_folder(site)
        loaded = load_site(folder)
        try:
            spec = read_spec(loaded, folder)
        except SpecError as error:
            raise WrongUseError(str(error)) from error
        for drawn in draw(spec, seed, run):
            for each in map(move_base.rates, rates or ("default", "full")):
                drives.append(move_base.drive_alone(ros, folder, drawn, each, speed, blocked))
                print_line(move_base.line(drives[-1]))
    if json:
        print_json({"bench": "move-base", "seed": seed, "drives": to_builtins(drives), **machine.describe()})


@bench_app.command("debounce", epilog="Example: fognav bench debounce --recordings DIR --png rules.png")
def debounce_command(
    *,
    recordings: Annotated[
        Path,
        typer.Option("--recordings", metavar="DIR", help="Recordings of a sonar (CSV: time in s, distance in cm)."),
    ],
    trials: Annotated[
        int, typer.Option("--trials", metavar="N", min=1, help="Obstacles per rule and echo rate.")
    ] = 500,
    hours: Annotated[float, typer.Option("--hours", metavar="H", min=0.01, help="Hours without an obstacle.")] = 2.0,
    seed: Annotated[int, typer.Option("--seed", metavar="N", min=0, help="Seed of the trials.")] = 1,
    png: Annotated[Path | None, typer.Option("--png", metavar="FILE", help="Draw the figures.")] = None,
    json: JsonOption = False,
) -> None:
    """Compare the debounce rules on recorded echoes.

    Obstacles of the recordings come, stay and go, with 50 to 100 % of their echoes. Figures: time to detection, misses
    after 2 s, losses within 4 s, how much of these 4 s the obstacle is known, and false alarms per hour of the
    background, as recorded and with 2 % false echoes; and what the evidence rule learns from the recordings: echo_rate
    and false_echo_rate.
    """
    from fognav_experiments.bench import debounce  # noqa: PLC0415  # keeps the other commands fast

    with exit_codes():
        check_writable(png)
        try:
            loaded = debounce.recordings_in(recordings)
        except ValueError as error:
            raise WrongUseError(str(error)) from error
        rows = debounce.measure(loaded, trials, hours, seed, print_line)
        if png is not None:
            debounce.draw(rows, png)
    learned = [{"echo_rate": round(r.echo_rate, 3), "false_echo_rate": round(r.false_echo_rate, 3)} for r in loaded]
    asked = {"trials": trials, "hours": hours, "seed": seed, "readings": sum(r.samples for r in loaded)}
    if json:
        print_json({"bench": "debounce", **asked, "learned": learned, "rows": rows, **machine.describe()})
        return
    for values in learned:
        console.print("learned: " + "  ".join(f"{name} {value}" for name, value in values.items()), markup=False)
    for line in debounce.table(rows):
        console.print(line, markup=False, soft_wrap=True)


@bench_app.command("reactions", epilog="Example: fognav bench reactions --trials 200 --write docs/reaction-times.md")
def reactions_command(  # noqa: PLR0913  # one parameter for each option
    *,
    trials: Annotated[
        int, typer.Option("--trials", metavar="N", min=1, help="Trials of each process or pair that dies or hangs.")
    ] = 3,
    others: Annotated[
        int | None, typer.Option("--others", metavar="N", min=0, help="Trials of each other fault; default: as many.")
    ] = None,
    robots: Annotated[int, typer.Option("--robots", metavar="N", min=1, max=32, help="Robots at once.")] = 2,
    log: Annotated[
        Path | None, typer.Option("--log", metavar="FILE", help="Keep each trial there, and continue the ones there.")
    ] = None,
    write: Annotated[
        Path | None,
        typer.Option("--write", metavar="FILE", help="Write the tables to a Markdown file; its remarks stay."),
    ] = None,
    only: Annotated[
        list[str] | None,
        typer.Option("--only", metavar="KIND", help="Only process, device, fog, operator, key or page; repeatable."),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Measure how soon the wheels stop.

    Processes of driving robots are killed or stopped, one by one and in pairs; sensors, lidar, map, planner and network
    fail; an operator stops the robot, or drives it by hand and lets go. The time ends when the emulated base's wheels
    are commanded to stand, or to be slow. A trial takes some five seconds. Exit code 1: one was beyond its limit.
    """
    from fognav_experiments.bench.reactions import trials as reactions  # noqa: PLC0415  # keeps the other commands fast

    kernels.warm_cache(print_line)
    other = trials if others is None else others
    with exit_codes():
        check_writable(log)
        check_writable(write)
        rows = reactions.run(trials, other, robots, log, write, print_line, only or ())
    if json:
        print_json({"bench": "reactions", "trials": trials, "others": other, "rows": rows, **machine.describe()})
    else:
        for values in rows:
            console.print("  ".join(f"{name} {value}" for name, value in values.items()), markup=False)
    if any(each["beyond_limit"] for each in rows):
        raise typer.Exit(NOT_TRUE)


@bench_app.command("mutation", epilog="Example: fognav bench mutation --part guardian --module core")
def mutation_command(
    *,
    part: Annotated[
        list[str] | None, typer.Option("--part", metavar="NAME", help="Only this part; may be repeated.")
    ] = None,
    module: Annotated[
        str, typer.Option("--module", metavar="NAME", help="Only mutants of modules whose name ends so.")
    ] = "",
    jobs: Annotated[int, typer.Option("--jobs", metavar="N", min=0, help="Mutants at once; 0: one per core.")] = 0,
    json: JsonOption = False,
) -> None:
    """Test the tests of what stops the robot.

    Changes one operator, number or statement of safety gate, guardian, watchdog, recoveries or maneuvers, and runs
    their tests, which must notice it; prints each change that none does. Exit code 1: fewer than 90 percent of the
    changes of a part are noticed.
    """
    from fognav_experiments import mutation  # noqa: PLC0415  # keeps the other commands fast
    from fognav_experiments.mutation import parts_named  # noqa: PLC0415  # same

    def tell(text: str) -> None:
        console.print(text, markup=False, soft_wrap=True)

    with exit_codes():
        root, chosen = checkout.root(), parts_named(part or [])
        figures = {
            each.name: mutation.measure(each, root, jobs=jobs or os.cpu_count() or 1, only=module, tell=tell)
            for each in chosen
        }
    if json:
        print_json({"bench": "mutation", "parts": mutation.report_values(figures)})
    else:
        for line in mutation.report_lines(figures):
            tell(line)
    if not mutation.passes(figures):
        raise typer.Exit(NOT_TRUE)
