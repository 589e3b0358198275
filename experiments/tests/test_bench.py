"""`fognav bench`: the figures that others rely on are there, and those that can be checked are right."""

import json
import os
import socket
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from fog_kernels.components import Components
from fog_runtime.configuration.site import load_site
from fog_supervisor.servers import ServerError
from fog_supervisor.supervisor import NotReadyError
from fognav.__main__ import app
from fognav.programs import SERVERS, SERVICES
from fognav_experiments.bench import air, common, cores, fleet, fleet_live, floors, pipeline, planner, rest
from fognav_experiments.bench import console as console_events
from fognav_experiments.bench import floor as floor_bench
from fognav_experiments.bench.common import make_office
from fognav_experiments.bench.robot import write_site as write_robot_site


def test_office_is_connected_and_the_same_for_the_same_seed() -> None:
    floor = common.make_office(60.0, 40.0, seed=3)
    assert floor.geometry.shape == (800, 1200)
    assert np.array_equal(floor.cells, common.make_office(60.0, 40.0, seed=3).cells)
    labels = Components(floor.cells).labels(*floor.geometry.whole)
    counts = np.bincount(labels[labels >= 0])
    assert counts.max() > 0.95 * counts.sum()


def test_every_robot_of_a_fleet_is_planned_refused_and_planned_again() -> None:
    rng = np.random.default_rng(1)
    map_ = fleet.FleetMap(common.make_office(60.0, 40.0), 10, rng)
    robots = fleet.Fleet(map_, 4, 3, rng)
    seen: list[tuple[int, int]] = []
    figures = fleet.measure(map_, robots, 1, lambda done, total: seen.append((done, total)))
    assert seen == [(1, 1)]
    assert robots.core.replanner.refusals == {208: 4}
    assert figures["replans"] == 4
    for key in ("replan_p50_ms", "replan_p99_ms", "cut_off_ms", "back_ms", "rss_mb", "bytes_per_robot"):
        assert isinstance(figures[key], float | int)
        assert figures[key] > 0
    path = robots.core.missions.of("r0").plan
    assert path is not None
    assert path.route is not None


@pytest.mark.live
@pytest.mark.long
async def test_every_robot_of_a_real_planner_gets_its_path_its_refusal_and_a_path_again() -> None:
    rng = np.random.default_rng(1)
    map_ = fleet.FleetMap(common.make_office(60.0, 40.0), 10, rng)
    seen: list[tuple[int, int]] = []
    robots = fleet.place_fleet(map_, 4, 3, rng)
    figures = await fleet_live.measure(map_, robots, 1, lambda done, total: seen.append((done, total)), quiet_s=0.5)
    assert seen == [(1, 1)]
    assert figures["replans"] == 4
    for key in ("replan_p50_ms", "replan_p99_ms", "cut_off_ms", "cut_off_explained_ms", "back_ms", "goal_fields_mb"):
        assert figures[key] > 0
    assert figures["cut_off_explained_ms"] >= figures["cut_off_ms"]
    assert figures["rss_mb"] > 50
    # A path of two points has some 100 bytes, and a delta more; a heartbeat of the map comes ten times a second.
    assert figures["bytes_per_robot"] > 200
    assert figures["steady_bytes_per_robot_s"] > 100


@pytest.mark.live
@pytest.mark.long
async def test_real_services_start_on_a_floor_and_lead_a_robot_across_it_and_round_a_zone(tmp_path: Path) -> None:
    cells = floor_bench.prepare(tmp_path, 60.0, 40.0)
    assert cells == 1200 * 800
    steps: list[str] = []
    figures = await floor_bench.measure(tmp_path, cells, 60.0, 40.0, steps.append)
    assert steps == ["starting the map-service", "starting the planner", "planning"]
    for key in ("map_ready_s", "planner_ready_s", "path_ms", "replan_ms"):
        assert figures[key] > 0
    for service in ("map", "planner"):
        assert figures[f"{service}_peak_mb"] >= figures[f"{service}_rss_mb"] > 50
        assert figures[f"{service}_peak_bytes_per_cell"] == pytest.approx(
            1e6 * figures[f"{service}_peak_mb"] / cells, rel=0.01
        )


@pytest.mark.parametrize("cells", [None, "map"])
def test_planner_figures_count_what_equals_its_reference(cells, tmp_path, monkeypatch):
    small = common.make_office(60.0, 40.0)
    monkeypatch.setattr(planner, "make_office", lambda **_: small)
    options = ["--queries", "3", "--json"]
    if cells is not None:
        rows = ["." * 130, "." * 60 + "@" + "." * 69, "." * 130] + ["." * 130] * 60
        (tmp_path / "m.map").write_text("\n".join(["type octile", "height 63", "width 130", "map", *rows]))
        (tmp_path / "m.scen").write_text("version 1\n0\tm.map\t130\t63\t2\t30\t127\t30\t125.0\n")
        options += ["--map", str(tmp_path / "m.map"), "--scen", str(tmp_path / "m.scen")]
    done = CliRunner().invoke(app, ["bench", "planner", *options])
    assert done.exit_code == 0, done.output
    printed = json.loads(done.stdout)
    assert printed["queries"] == printed["optimal"] == (3 if cells is None else 1)
    assert printed["replans"] == printed["replans_optimal"] > 0
    for key in (
        "median_ms",
        "p99_ms",
        "expansions_median",
        "replan_median_ms",
        "field_median_ms",
        "shortcut_median_ms",
    ):
        assert printed[key] > 0
    assert printed["dearer_than_gradient_worst_percent"] < 1.0
    assert ("tcod_median_ms" in printed) != ("tcod" in printed["not_installed"])
    assert printed["versions"].keys() == {"python", "numba", "numpy"}


def test_planner_bench_names_the_file_that_is_no_map(tmp_path):
    (tmp_path / "m.map").write_text("a picture")
    done = CliRunner().invoke(app, ["bench", "planner", "--map", str(tmp_path / "m.map")])
    assert done.exit_code == 2
    assert "m.map: needs a line `map`" in " ".join(done.output.split())


def test_costmap_figures_are_of_the_whole_floor_and_of_legal_zones() -> None:
    floor = common.make_office(60.0, 40.0)
    figures = cores.measure_costmap(floor, 50, 1)
    assert figures["cells"] == 800 * 1200
    assert figures["portions"] >= 4, "a zone over the whole floor, put and removed"
    for key in (
        "full_ms",
        "window_ms",
        "worst_zone_ms",
        "worst_portion_ms",
        "load_zones_ms",
        "snapshot_ms",
        "worst_obstacles_ms",
    ):
        assert figures[key] > 0


@pytest.mark.live
@pytest.mark.usefixtures("forked_programs")
async def test_clients_of_every_kind_are_answered_while_the_heartbeat_is_timed(tmp_path) -> None:
    floor = common.make_office(60.0, 40.0)
    common.write_site(tmp_path, floor)
    figures = await rest.measure(tmp_path, floor, zones=50, clients=10, seconds=3.0, idle_s=0.5)
    assert (
        {"200", "201", "204", "413", "422"}
        <= figures["requests"].keys()
        <= {*["200", "201", "204", "413", "422", "503"]}
    )
    for key in ("heartbeat_gap_p50_ms", "heartbeat_gap_p99_ms", "heartbeat_gap_max_ms"):
        assert figures[f"idle_{key}"] > 0
        assert figures[key] > 0
    assert figures["rss_mb"] > 50
    for key in ("read_zones_ms", "ready_s", "list_zones_ms", "worst_zone_ms"):
        assert figures[key] > 0


@pytest.mark.parametrize("error", [NotReadyError("redis: exited with 1"), ServerError("mosquitto is not installed")])
def test_system_that_does_not_start_is_a_sentence_and_no_traceback(monkeypatch, error):
    async def measure(*_: object, **_options: object) -> None:
        raise error

    monkeypatch.setattr(rest, "measure", measure)
    done = CliRunner().invoke(app, ["bench", "rest"])
    assert (done.exit_code, f"fognav: {error}" in done.output) == (1, True)


@pytest.mark.live
@pytest.mark.long
async def test_readers_of_events_all_get_poses_and_hazards(tmp_path: Path) -> None:
    figures = await console_events.measure(tmp_path, readers=30, robots=2, seconds=3.0, on_phase=print)
    assert figures["lost_readers"] == 0
    assert figures["poses"] > 0
    assert figures["areas"] > 0
    assert 0 < figures["pose_p50_ms"] <= figures["pose_p99_ms"]
    assert figures["heartbeat_gap_p50_ms"] > 0


@pytest.mark.live
@pytest.mark.long
async def test_list_of_floors_is_asked_and_its_floors_are_answered(tmp_path: Path) -> None:
    figures = await console_events.measure_floors(tmp_path, 30, 3.0, print)
    assert 0.0 < figures["age_p50_s"] <= figures["age_p99_s"] < 3.0
    assert figures["answers"] > 30
    assert figures["cpu_percent"] > 0.0


def test_localization_figures_are_there_and_the_search_and_match_ran() -> None:
    figures = cores.measure_localization(common.make_office(60.0, 40.0), 300, 60, 2, 1)
    assert figures["cells"] == 800 * 1200
    for key in (
        "cycle_ms",
        "reference_cycle_ms",
        "ratio",
        "move_ms",
        "score_ms",
        "clusters_ms",
        "match_ms",
        "search_ms",
    ):
        assert figures[key] > 0


def test_dwa_figures_are_of_both_bodies_and_of_a_whole_decision_and_come_with_schema_machine_and_versions() -> None:
    done = CliRunner().invoke(app, ["bench", "dwa", "--repeats", "2", "--json"])
    assert done.exit_code == 0, done.output
    figures = json.loads(done.stdout)
    assert (figures["schema"], figures["bench"], figures["arcs"]) == (1, "dwa", 875)
    assert figures["machine"]["cores"] >= 1
    assert figures["machine"]["governor"]
    assert set(figures["versions"]) == {"python", "numba", "numpy"}
    assert all(figures[key] > 0 for key in ("decision_ms", "cycle_ms"))
    assert {"field_ms", "field_long_ms", "cycle_long_ms", "peer_ratio"} <= figures.keys()


# --- from readings to the map ---


def test_site_of_the_benchmark_is_valid_and_one_area_has_most_nodes(tmp_path):
    pipeline.write_nodes(tmp_path, 400)
    site = load_site(tmp_path).site
    sizes = sorted(len(definition.nodes) for definition in site.definitions())
    assert (sum(sizes), sizes[-1], sizes[-2]) == (400, 130, 4)


@pytest.mark.live
@pytest.mark.long
async def test_no_reading_of_a_small_load_is_lost_and_hazards_reach_the_map(tmp_path):
    phases: list[str] = []
    figures = await pipeline.measure(tmp_path, nodes=12, rate=20.0, robots=2, seconds=5.0, on_phase=phases.append)
    assert len(phases) == 3
    assert figures["sent"] >= 1200
    assert figures["lost"] == 0
    assert figures["hazards"] >= 1
    assert 0 < figures["confirmed_to_delta_p50_ms"] <= figures["confirmed_to_delta_p99_ms"]
    assert figures["confirmed_to_delta_p50_ms"] < figures["reading_to_delta_p50_ms"]
    assert figures["aggregator_us_per_reading"] > 0


@pytest.mark.live
@pytest.mark.timeout(300)
@pytest.mark.usefixtures("forked_programs")
async def test_robots_that_are_played_on_a_floor_drive_and_each_of_its_programs_is_counted(tmp_path: Path) -> None:
    found = await floors.measure(tmp_path, [1], floors.Traffic(2, 3, settle_s=5.0), 5.0, lambda _: None)
    (one,) = found["counts"]
    assert one["driven_m"] > 0.3
    assert one["memory_mb"].keys() == one["cpu_percent"].keys() == {*SERVERS, *SERVICES}
    assert min(one["memory_mb"].values()) > 1.0


def test_model_of_floors_says_how_far_it_is_off_between_its_ends() -> None:
    counts = [
        {"floors": n, "memory_mb": {"a": mb, "b": 10.0}, "cpu_percent": {"a": 5.0 * n}}
        for n, mb in ((1, 90.0), (2, 180.0), (5, 490.0))
    ]
    assert floors.model(counts) == {
        "memory_mb": {"fixed": 0.0, "each_floor": 100.0, "error_percent": {"2": 5.3}},
        "cpu_percent": {"fixed": 0.0, "each_floor": 5.0, "error_percent": {"2": 0.0}},
    }


def test_frames_and_bytes_of_a_connection_are_what_went_over_it():
    with socket.create_server(("127.0.0.1", 0)) as server, socket.create_connection(server.getsockname()) as client:
        served, _ = server.accept()
        with served:
            port = server.getsockname()[1]
            before = air.traffic(os.getpid(), port)
            for _ in range(3):
                client.sendall(b"x" * 2000)
                assert len(served.recv(4000)) == 2000
            carried = air.traffic(os.getpid(), port) - before
    assert carried.bytes == 6000
    assert carried.segments >= 4, "6,000 bytes are no less than four of Wi-Fi's frames"
    with pytest.raises(RuntimeError, match="no connection"):
        air.traffic(os.getpid(), 1)


def test_frame_of_wifi_takes_as_long_as_its_standard_says():
    # DIFS 28, half of 15 slots of 9, HT-mixed preamble 36 and signal extension 6, SIFS 10, acknowledgement 34 us at 24
    # Mbit/s, 50 at 6; 1,500 bytes of IP in 54 of frames.
    one = air.Traffic(segments=1, bytes=1448)
    assert one.airtime_s(65e6) == pytest.approx(181.5e-6 + 8 * (1500 + 54) / 65e6)
    assert one.airtime_s(6.5e6) == pytest.approx(197.5e-6 + 8 * (1500 + 54) / 6.5e6)


def test_site_with_a_node_is_valid(tmp_path):
    loaded = load_site(write_robot_site(tmp_path, make_office(), node=True))
    assert [node.id for node in loaded.site.nodes] == ["n1"]
