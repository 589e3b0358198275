"""Drives the simulated robot by ROS 1's navigation stack, the thesis's, over the routes of a site's experiment.

The programs are those of `ros-planning/navigation`, built by whoever wants to compare (docs/benchmarks.md says how), on
Debian's packages of ROS: `move_base` with DWA and navfn, `amcl`, `map_server`, `rosmaster`. This process is the robot:
its wheels, odometry and lidar, on ROS's simulated clock. Odometry and lidar err as they do for Fognav's agent, but each
scan is of one moment, and nothing goes over serial lines: both in favour of ROS.
"""

from __future__ import annotations

import importlib
import math
import os
import subprocess
import sys
import threading
import time
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, Self

import msgspec
import numpy as np
import psutil

from fog_runtime.configuration.site import load_site
from fog_supervisor.net import LOOPBACK, free_port
from fognav.output import FailedError, WrongUseError
from fognav_experiments.comparison.drives import ends_of, start_of
from fognav_sim.barrier import barrier_across
from fognav_sim.devices import make_base
from fognav_sim.drive.drive import GOAL_TOLERANCE_M, drive_timeout_s
from fognav_sim.floor import Floor
from fognav_sim.sensors import LIDAR_MAX_M, LIDAR_MIN_M
from fognav_sim.world import World

if TYPE_CHECKING:
    from fog_runtime.configuration.site import LoadedSite
    from fognav_experiments.comparison.drives import RouteDraw

Rates = Literal["default", "full"]
PROGRAMS: Final = ("rosmaster", "map_server", "amcl", "move_base")
_DEBIAN_PACKAGES: Final = "/usr/lib/python3/dist-packages"
_STEP_S: Final = 0.01
_ODOMETRY_S: Final = 0.05
_SCAN_S: Final = 0.18
"""5.5 turns a second, as an RPLidar A1."""
_BEAMS: Final = 360
_COMMAND_LASTS_S: Final = 0.5
_READY_S: Final = 60.0
_STANDS_S: Final = 2.0
"""A drive has ended when the robot has stood at its goal for so long, or `move_base` has given up."""
_GAVE_UP: Final = frozenset({4, 5, 9})
"""actionlib's states ABORTED, REJECTED and LOST."""


def rates(name: str) -> Rates:
    """Return the rates of this name; raises `WrongUseError`."""
    if name not in ("default", "full"):
        raise WrongUseError(f"--rates {name}: choose default or full")
    return "default" if name == "default" else "full"


def parameters(rates: Rates, radius: float) -> dict[str, Any]:
    """Return the parameters of `move_base`: a TurtleBot 3's, with the thesis's changes (its sections 4.5 and 5.4)."""
    full = rates == "full"
    window = 2.0 if full else 3.0
    common = {
        "robot_radius": radius,
        "obstacle_range": 8.0,
        "raytrace_range": 8.5,
        "inflation_radius": 0.55,
        "cost_scaling_factor": 3.0,
        "map_type": "costmap",
        "observation_sources": "scan",
        "scan": {
            "sensor_frame": "laser", "data_type": "LaserScan", "topic": "/scan", "marking": True, "clearing": True,
            "inf_is_valid": True,
        },
        "robot_base_frame": "base_link",
        "transform_tolerance": 0.5,
    }  # fmt: skip
    layers = [
        {"name": "static", "type": "costmap_2d::StaticLayer"},
        {"name": "obstacles", "type": "costmap_2d::ObstacleLayer"},
        {"name": "inflation", "type": "costmap_2d::InflationLayer"},
    ]
    inflation = {"inflation_radius": common["inflation_radius"], "cost_scaling_factor": common["cost_scaling_factor"]}
    seen = {name: common[name] for name in ("observation_sources", "scan", "obstacle_range", "raytrace_range")}
    parts = {"obstacles": seen, "inflation": inflation}
    return {
        "controller_frequency": 5.0 if full else 10.0,
        "planner_frequency": 0.0 if full else 10.0,
        "recovery_behavior_enabled": True,
        "oscillation_timeout": 10.0,
        "oscillation_distance": 0.2,
        "base_local_planner": "dwa_local_planner/DWAPlannerROS",
        "base_global_planner": "navfn/NavfnROS",
        "global_costmap": {
            **common, **parts, "global_frame": "map", "update_frequency": 2.0 if full else 10.0,
            "publish_frequency": 0.0, "plugins": layers,
        },
        "local_costmap": {
            **common, **parts, "global_frame": "odom", "update_frequency": 5.0 if full else 10.0,
            "publish_frequency": 0.0, "rolling_window": True, "width": window, "height": window, "resolution": 0.05,
            "plugins": layers[1:],
        },
        "DWAPlannerROS": {
            "max_vel_x": 0.3, "min_vel_x": -0.1, "max_vel_y": 0.0, "min_vel_y": 0.0, "max_vel_trans": 0.3,
            "min_vel_trans": 0.05, "max_vel_theta": 2.75, "min_vel_theta": 0.3, "acc_lim_x": 2.5, "acc_lim_y": 0.0,
            "acc_lim_theta": 3.2, "xy_goal_tolerance": 0.1, "yaw_goal_tolerance": 3.15, "latch_xy_goal_tolerance": True,
            "sim_time": 1.5 if full else 1.7, "vx_samples": 25, "vy_samples": 1, "vth_samples": 35,
            "path_distance_bias": 32.0, "goal_distance_bias": 20.0, "occdist_scale": 0.02,
            "forward_point_distance": 0.325, "stop_time_buffer": 0.2, "scaling_speed": 0.25, "max_scaling_factor": 0.2,
        },
    }  # fmt: skip


def localization(start: tuple[float, float, float]) -> dict[str, Any]:
    """Return the parameters of `amcl`: a TurtleBot 3's, for a lidar that reaches 12 m, at a known start (m, rad)."""
    x, y, theta = start
    return {
        "min_particles": 500, "max_particles": 3000, "kld_err": 0.02, "update_min_d": 0.2, "update_min_a": 0.2,
        "resample_interval": 1, "transform_tolerance": 0.5, "gui_publish_rate": -1.0, "laser_max_range": LIDAR_MAX_M,
        "laser_max_beams": 180, "laser_model_type": "likelihood_field", "odom_model_type": "diff-corrected",
        "odom_alpha1": 0.1, "odom_alpha2": 0.1, "odom_alpha3": 0.1, "odom_alpha4": 0.1, "odom_frame_id": "odom",
        "base_frame_id": "base_link", "initial_pose_x": x, "initial_pose_y": y, "initial_pose_a": theta,
    }  # fmt: skip


class PeerDrive(msgspec.Struct, frozen=True, kw_only=True):
    """How a route went; lengths in m, times in s of the simulated clock.

    `cpu`: processor time (s) of each program from the goal on, `memory_mb` its resident memory at the end. `load`: of
    the machine, at the end. `clock`: how fast the simulated clock ran.
    """

    rates: Rates
    run: int
    route: str
    area: str | None
    outcome: str
    distance_m: float
    time_s: float
    contacts: int
    min_clearance_m: float
    cpu: dict[str, float]
    memory_mb: dict[str, float]
    clock: float
    load: float


def line(drive: PeerDrive) -> str:
    """Return a drive in a line."""
    shares = ", ".join(f"{name} {100.0 * used / drive.time_s:.2f} %" for name, used in drive.cpu.items())
    blocked = f", {drive.area} blocked" if drive.area else ""
    return (
        f"run {drive.run} {drive.route}{blocked}, {drive.rates}: {drive.outcome}, {drive.distance_m:.1f} m in"
        f" {drive.time_s:.1f} s; of a core: {shares}; move_base {drive.memory_mb['move_base']:.0f} MB"
    )


class RosRobot:
    """The simulated robot with ROS's programs, at the start of a drawn route; a context."""

    def __init__(self, built: Path, loaded: LoadedSite, drawn: RouteDraw, rates: Rates, speed: float) -> None:
        """`built`: the folder `devel` of the workspace in which the programs were built; `speed`: of the clock."""
        self._built, self._loaded, self._drawn, self._rates, self._speed = built, loaded, drawn, rates, speed
        start = start_of(loaded, drawn)
        robot = msgspec.structs.replace(loaded.site.robots[0], start=start)
        self._axle_m = make_base("roomba600").axle_m
        floor = Floor(loaded.map.geometry, loaded.map.cells)
        self.world = World(floor, robot, drawn.seed, axle_m=self._axle_m)
        self.now = 0.0
        self._odometry = np.zeros(3)
        self._command = (0.0, 0.0, -math.inf)
        self._status: int | None = None
        """Of the latest goal, as actionlib numbers them; 0 without a goal, None before `move_base` said anything."""
        self._contexts = ExitStack()
        self._processes: dict[str, psutil.Process] = {}
        programs = (Path("/usr/bin/rosmaster"), *(built / "lib" / name / name for name in PROGRAMS[1:]))
        if missing := [str(each) for each in programs if not each.is_file()]:
            raise WrongUseError(f"no {', '.join(missing)}: build them as docs/benchmarks.md says, and name their devel")
        sys.path.append(_DEBIAN_PACKAGES)

    def __enter__(self) -> Self:
        """Start the programs, and wait until `move_base` takes goals."""
        port = free_port()
        here = {"ROS_MASTER_URI": f"http://{LOOPBACK}:{port}", "ROS_HOSTNAME": "localhost"}
        os.environ |= here
        root = self._built
        self._environment = os.environ | here | {
            "LD_LIBRARY_PATH": str(root / "lib"),
            "ROS_PACKAGE_PATH": f"{root.parent / 'src'}:/usr/share",
            "CMAKE_PREFIX_PATH": f"{root}:/usr",
            "PYTHONPATH": _DEBIAN_PACKAGES,
        }  # fmt: skip
        try:
            self._start("rosmaster", ["/usr/bin/rosmaster", "--core", "-p", str(port)])
            self._connect(port)
            x, y, theta = self.world.pose
            self._set("/use_sim_time", value=True)
            self._set("/amcl", value=localization((x, y, theta)))
            self._set("/move_base", value=parameters(self._rates, self._loaded.site.robots[0].radius))
            library = root / "lib"
            self._start("map_server", [library / "map_server/map_server", self._loaded.directory / "map.yaml"])
            self._start("amcl", [library / "amcl/amcl", "__name:=amcl"])
            self._start("move_base", [library / "move_base/move_base", "__name:=move_base"])
            self._ticking = threading.Event()
            thread = threading.Thread(target=self._live, daemon=True)
            thread.start()
            self._contexts.callback(thread.join)
            self._contexts.callback(self._ticking.set)
            self._wait(lambda: self._status is not None, "move_base takes goals")
        except BaseException:
            self._contexts.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        """Stop the programs."""
        self._contexts.close()

    def _start(self, name: str, command: list[Any]) -> None:
        process = subprocess.Popen(
            [str(each) for each in command], env=self._environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )

        def stop() -> None:
            process.terminate()
            try:
                process.wait(10.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

        self._contexts.callback(stop)
        self._processes[name] = psutil.Process(process.pid)

    def _set(self, name: str, *, value: object) -> None:
        self._rospy.set_param(name, value)

    def _connect(self, port: int) -> None:
        rospy = self._rospy = importlib.import_module("rospy")
        self._messages = {
            name: importlib.import_module(f"{name}.msg")
            for name in (
                "geometry_msgs",
                "nav_msgs",
                "sensor_msgs",
                "rosgraph_msgs",
                "tf2_msgs",
                "actionlib_msgs",
                "std_msgs",
            )
        }
        master = importlib.import_module("rosgraph").Master("fognav", f"http://{LOOPBACK}:{port}")
        self._wait(lambda: _answers(master), "rosmaster answers")
        rospy.init_node("fognav_robot", disable_signals=True, anonymous=True)
        kinds = self._messages
        self._clock = rospy.Publisher("/clock", kinds["rosgraph_msgs"].Clock, queue_size=1)
        self._tf = rospy.Publisher("/tf", kinds["tf2_msgs"].TFMessage, queue_size=10)
        self._fixed = rospy.Publisher("/tf_static", kinds["tf2_msgs"].TFMessage, queue_size=1, latch=True)
        self._odom = rospy.Publisher("/odom", kinds["nav_msgs"].Odometry, queue_size=1)
        self._scan = rospy.Publisher("/scan", kinds["sensor_msgs"].LaserScan, queue_size=1)
        self._goals = rospy.Publisher("/move_base_simple/goal", kinds["geometry_msgs"].PoseStamped, queue_size=1)
        rospy.Subscriber("/cmd_vel", kinds["geometry_msgs"].Twist, self._on_command, queue_size=1)
        rospy.Subscriber("/move_base/status", kinds["actionlib_msgs"].GoalStatusArray, self._on_status, queue_size=1)
        self._fixed.publish(kinds["tf2_msgs"].TFMessage([self._transform("base_link", "laser", (0.0, 0.0, 0.0))]))
        self._contexts.callback(rospy.signal_shutdown, "done")

    def _wait(self, condition: Any, what: str) -> None:  # noqa: ANN401  # a question
        deadline = time.monotonic() + _READY_S
        while not condition():
            if time.monotonic() > deadline:
                raise FailedError(f"waited {_READY_S:.0f} s until {what}")
            time.sleep(0.05)

    # --- The robot --------------------------------------------------------------------------------------------------

    def _on_command(self, twist: Any) -> None:  # noqa: ANN401  # ROS's
        self._command = (twist.linear.x, twist.angular.z, self.now)

    def _on_status(self, array: Any) -> None:  # noqa: ANN401  # ROS's
        self._status = array.status_list[-1].status if array.status_list else 0

    def _live(self) -> None:
        """Run the world on the simulated clock, until told to stop."""
        began, steps = time.monotonic(), 0
        angles = np.arange(_BEAMS) * (math.tau / _BEAMS) - math.pi
        while not self._ticking.is_set():
            ahead = began + steps * _STEP_S / self._speed - time.monotonic()
            if ahead > 0.0:
                time.sleep(ahead)
            steps += 1
            self.now = steps * _STEP_S
            v, w, at = self._command
            if self.now - at > _COMMAND_LASTS_S:
                v = w = 0.0
            half = w * self._axle_m / 2.0
            self.world.set_wheels(v - half, v + half)
            self._roll(*self.world.step(_STEP_S))
            stamp = self._rospy.Time.from_sec(self.now)
            self._clock.publish(self._messages["rosgraph_msgs"].Clock(clock=stamp))
            if steps % round(_ODOMETRY_S / _STEP_S) == 0:
                self._publish_odometry(stamp, v, w)
            if steps % round(_SCAN_S / _STEP_S) == 0:
                self._publish_scan(stamp, angles)

    def _roll(self, left: float, right: float) -> None:
        travel, turn = (left + right) / 2.0, (right - left) / self._axle_m
        middle = self._odometry[2] + turn / 2.0
        self._odometry += (travel * math.cos(middle), travel * math.sin(middle), turn)

    def _transform(self, parent: str, child: str, pose: Any, stamp: Any = None) -> Any:  # noqa: ANN401  # ROS's
        x, y, theta = pose
        geometry, header = self._messages["geometry_msgs"], self._header(parent, stamp)
        turned = geometry.Quaternion(x=0.0, y=0.0, z=math.sin(theta / 2.0), w=math.cos(theta / 2.0))
        moved = geometry.Transform(translation=geometry.Vector3(x, y, 0.0), rotation=turned)
        return geometry.TransformStamped(header=header, child_frame_id=child, transform=moved)

    def _header(self, frame: str, stamp: Any) -> Any:  # noqa: ANN401  # ROS's
        return self._messages["std_msgs"].Header(stamp=stamp or self._rospy.Time(), frame_id=frame)

    def _publish_odometry(self, stamp: Any, v: float, w: float) -> None:  # noqa: ANN401  # ROS's
        transform = self._transform("odom", "base_link", self._odometry, stamp)
        self._tf.publish(self._messages["tf2_msgs"].TFMessage([transform]))
        odom = self._messages["nav_msgs"].Odometry(header=transform.header, child_frame_id="base_link")
        odom.pose.pose.position.x, odom.pose.pose.position.y = self._odometry[:2]
        odom.pose.pose.orientation = transform.transform.rotation
        odom.twist.twist.linear.x, odom.twist.twist.angular.z = v, w
        self._odom.publish(odom)

    def _publish_scan(self, stamp: Any, angles: Any) -> None:  # noqa: ANN401  # ROS's
        scan = self._messages["sensor_msgs"].LaserScan(
            header=self._header("laser", stamp),
            angle_min=float(angles[0]),
            angle_max=float(angles[-1]),
            angle_increment=math.tau / _BEAMS,
            time_increment=0.0,
            scan_time=_SCAN_S,
            range_min=LIDAR_MIN_M,
            range_max=LIDAR_MAX_M,
            ranges=np.nan_to_num(self.world.lidar(angles, self.now), nan=math.inf).tolist(),
            intensities=[],
        )
        self._scan.publish(scan)

    # --- The drive --------------------------------------------------------------------------------------------------

    def drive(self, *, blocked: bool) -> PeerDrive:
        """Send the robot to the route's goal, and return how that went; `blocked`: the drawn barrier is placed."""
        site, drawn, world = self._loaded, self._drawn, self.world
        start, goal = ends_of(site, drawn)
        began, before, contacts, wall = self.now, self._cpu(), world.contacts, time.monotonic()
        driven = world.distance
        pose = self._messages["geometry_msgs"].PoseStamped(header=self._header("map", None))
        pose.pose.orientation.w = 1.0
        pose.pose.position.x, pose.pose.position.y = goal.x, goal.y
        self._status = 0
        self._goals.publish(pose)
        waiting, outcome, stands_since = blocked, "", math.inf
        timeout_s = drive_timeout_s((start.x, start.y), (goal.x, goal.y))
        clearance = math.inf
        while not outcome:
            time.sleep(0.05)
            if waiting and world.distance - driven >= drawn.trigger_m:
                area = next(each for each in site.site.areas if each.id == drawn.area)
                world.place(barrier_across(area, site.site, site.map, drawn.seed))
                waiting = False
            x, y, _ = world.pose
            clearance = min(clearance, world.clearance())
            at_goal = math.hypot(x - goal.x, y - goal.y) <= GOAL_TOLERANCE_M
            moves = any(self._command[:2]) and self.now - self._command[2] <= _COMMAND_LASTS_S
            stands_since = min(stands_since, self.now) if at_goal and not moves else math.inf
            if self.now - stands_since >= _STANDS_S:
                outcome = "reached"
            elif world.contacts > contacts:
                outcome = "contact"
            elif self._status in _GAVE_UP:
                outcome = "refused"
            elif self.now - began > timeout_s:
                outcome = "timeout"
        ended = stands_since if outcome == "reached" else self.now
        after = self._cpu()
        return PeerDrive(
            rates=self._rates,
            run=drawn.run,
            route=drawn.route.name,
            area=drawn.area if blocked else None,
            outcome=outcome,
            distance_m=round(world.distance - driven, 2),
            time_s=round(ended - began, 2),
            contacts=world.contacts - contacts,
            min_clearance_m=round(clearance, 3),
            cpu={name: round(after[name] - before[name], 2) for name in after},
            memory_mb={name: round(each.memory_info().rss / 2**20, 1) for name, each in self._processes.items()},
            clock=round((self.now - began) / (time.monotonic() - wall), 2),
            load=round(os.getloadavg()[0], 1),
        )

    def _cpu(self) -> dict[str, float]:
        return {name: sum(each.cpu_times()[:2]) for name, each in self._processes.items()}


def _answers(master: Any) -> bool:  # noqa: ANN401  # ROS's
    try:
        master.getPid()
    except (OSError, importlib.import_module("rosgraph").MasterException):
        return False
    return True


def drive_alone(  # what is driven, by what
    built: Path, folder: Path, drawn: RouteDraw, rates: Rates, speed: float, blocked: bool,  # noqa: FBT001  # submitted
) -> PeerDrive:  # fmt: skip
    """Drive a route in a process of its own: `rospy` starts once in a process. Raises as `RosRobot`."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as alone:
        return alone.submit(_drive, built, folder, drawn, rates, speed, blocked).result()


def _drive(built: Path, folder: Path, drawn: RouteDraw, rates: Rates, speed: float, blocked: bool) -> PeerDrive:  # noqa: FBT001  # as above
    with RosRobot(built, load_site(folder), drawn, rates, speed) as robot:
        return robot.drive(blocked=blocked)
