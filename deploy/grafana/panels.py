"""What Grafana shows: dashboards of rows of panels, each with its Prometheus queries.

`make_dashboards.py` writes Grafana's files from this table, and tests ask a real Prometheus each of these queries.
"""

from dataclasses import dataclass
from typing import Final, Literal

from fog_contracts.channels import AGGREGATOR_HEARTBEAT
from fog_contracts.messages import PLAN_CODES

Kind = Literal["lines", "stacked", "states", "number"]


@dataclass(frozen=True)
class Panel:
    """A picture of one or more queries, each with the legend of its series (`{{label}}` is replaced by its value).

    about: what it tells, and what is normal. unit: Grafana's name of it. needs: what must exist for the panel to have
    data, if a simulated system lacks it.
    """

    title: str
    about: str
    queries: tuple[tuple[str, str], ...]
    kind: Kind = "lines"
    unit: str = "short"
    width: int = 12
    needs: str = ""


@dataclass(frozen=True)
class Dashboard:
    """A page of panels in rows; `by_robot`: its queries name `$robot`, which the reader chooses."""

    uid: str
    title: str
    rows: tuple[tuple[str, tuple[Panel, ...]], ...]
    by_robot: bool = False


_R: Final = '{robot=~"$robot"}'


def _rate(metric: str, *labels: str) -> str:
    """Return how much a counter rises in a second, summed by the labels."""
    return f"sum by ({', '.join(labels)}) (rate({metric}[$__rate_interval]))"


def _mean(metric: str, *labels: str) -> str:
    """Return the mean of a histogram's observations, by the labels."""
    return f"{_rate(metric + '_sum', *labels)} / {_rate(metric + '_count', *labels)}"


ROBOTS: Final = Dashboard(
    "fognav-robots",
    "Robots",
    (
        (
            "What Fognav costs the robot",
            (
                Panel(
                    "CPU of planning, beside recorded drives",
                    "What a robot still plans itself, in cores, beside the means of recorded drives: `default` (it"
                    " plans all itself and knows nothing of the fog), `full` (it plans itself, the fog reports hazards)"
                    " and `fog`. Figures 6.5 and 6.9 of the master's thesis that Fognav follows show the same: above 1"
                    " core in its `default`, 0.2 to 0.5 in its `full`. The baselines hold for the processor that they"
                    " name; deploy/prometheus/make_baselines.py takes those of your own.",
                    (
                        (f"robot:planning_cpu:rate1m{_R}", "{{robot}} now"),
                        ("baseline:planning_cpu:mean", "recorded {{setup}} ({{machine}})"),
                    ),
                    unit="percentunit",
                    width=24,
                ),
                Panel(
                    "CPU by robot",
                    "All of Fognav's processes on a robot, in cores, beside the means of recorded drives by real"
                    " processes on the processor that the legend names.",
                    (
                        (f"robot:cpu:rate1m{_R}", "{{robot}} now"),
                        ("sum by (setup, machine) (baseline:process_cpu:mean)", "recorded {{setup}} ({{machine}})"),
                    ),
                    unit="percentunit",
                ),
                Panel(
                    "CPU by process",
                    "The agent localizes and follows; guardian and watchdog only pass commands on and watch. Beside"
                    " them the same processes in recorded drives.",
                    (
                        (f"robot_process:cpu:rate1m{_R}", "{{robot}} {{process}}"),
                        ("baseline:process_cpu:mean", "recorded {{setup}} {{process}}"),
                    ),
                    unit="percentunit",
                ),
                Panel(
                    "CPU by thread",
                    "Where an agent's time goes: `decide` plans, `map` unpacks the map, `python` does the rest; others"
                    " are zenoh's.",
                    (
                        (
                            _rate(f"fognav_thread_cpu_seconds_total{_R}", "robot", "process", "thread") + " > 0.001",
                            "{{robot}} {{process}}/{{thread}}",
                        ),
                    ),
                    "stacked",
                    "percentunit",
                ),
                Panel(
                    "CPU by thread, beside recorded drives",
                    "The threads that calculate, beside what their components took in recorded drives in lockstep:"
                    " there without sockets, event loop and waking up, so a real thread takes more. Compare how they"
                    " differ from setup to setup.",
                    (
                        (
                            _rate(
                                'fognav_thread_cpu_seconds_total{robot=~"$robot", thread=~"decide|python",'
                                ' process!="watchdog"}',
                                "robot",
                                "process",
                                "thread",
                            ),
                            "{{robot}} {{process}}/{{thread}} now",
                        ),
                        ("baseline:thread_cpu:mean", "recorded {{setup}} {{process}}/{{thread}}"),
                    ),
                    unit="percentunit",
                ),
                Panel(
                    "Memory",
                    "What each process keeps resident. It must not grow for hours.",
                    ((f"fognav_process_resident_bytes{_R}", "{{robot}} {{process}}"),),
                    "stacked",
                    "bytes",
                ),
                Panel(
                    "Lateness of the loops",
                    "How late 99 of 100 steps begin. Above 50 ms the computer is too busy.",
                    ((f"fognav_loop_lateness_p99_seconds{_R}", "{{robot}} {{loop}}"),),
                    unit="s",
                ),
                Panel(
                    "Traffic with the fog",
                    "Bytes that a robot sends and receives in a second, over all channels.",
                    (
                        (
                            _rate(f"fognav_bytes_total{_R}", "robot", "direction"),
                            "{{robot}} {{direction}}",
                        ),
                    ),
                    unit="Bps",
                ),
            ),
        ),
        (
            "What it does",
            (
                Panel(
                    "Mode",
                    "NORMAL is driving freely; HOLD, PROTECTIVE_STOP and FAULT stand.",
                    ((f"fognav_robot_mode{_R}", "{{robot}} {{mode}}"),),
                    "states",
                    width=24,
                ),
                Panel(
                    "Reasons of the mode",
                    "Why a robot is slow or stands.",
                    ((f"fognav_robot_reason{_R}", "{{robot}} {{reason}}"),),
                    "states",
                    width=24,
                    needs="a robot that is hindered",
                ),
                Panel(
                    "Age of the map",
                    "Since when the fog has not confirmed the robot's map. It slows down at 1 s and stops at 3 s.",
                    ((f"fognav_robot_map_age_seconds{_R}", "{{robot}}"),),
                    unit="s",
                ),
                Panel(
                    "Where it may be",
                    "Standard deviation of the position, along its least certain direction and across it. Above 0.35 m"
                    " the robot slows down.",
                    ((f"fognav_pose_sigma_meters{_R}", "{{robot}} {{direction}}"),),
                    unit="lengthm",
                ),
                Panel(
                    "Particles",
                    "Many mean that the localization is not sure.",
                    ((f"fognav_particles{_R}", "{{robot}}"),),
                ),
                Panel(
                    "Turns of the lidar",
                    "Whole scans in a second: 5 to 10, and none at rest.",
                    ((_rate(f"fognav_lidar_scans_total{_R}", "robot"), "{{robot}}"),),
                    unit="hertz",
                ),
            ),
        ),
        (
            "Its body",
            (
                Panel(
                    "Charge",
                    "Of the base's battery; 15 % is low.",
                    ((f"fognav_battery_charge_ratio{_R}", "{{robot}}"),),
                    unit="percentunit",
                ),
                Panel(
                    "Battery's voltage",
                    "It falls slowly; a sudden fall is a worn cell.",
                    ((f"fognav_battery_volts{_R}", "{{robot}}"),),
                    unit="volt",
                ),
                Panel(
                    "Wi-Fi",
                    "Strength of the signal. Below -75 dBm expect lost messages.",
                    ((f"fognav_wifi_level_dbm{_R}", "{{robot}} {{interface}}"),),
                    unit="dBm",
                    needs="a computer with Wi-Fi",
                ),
                Panel(
                    "Temperature",
                    "Of the robot's computer. A Raspberry Pi slows down at 80 degrees.",
                    ((f"fognav_computer_celsius{_R}", "{{robot}} {{zone}}"),),
                    unit="celsius",
                    needs="a computer with a temperature sensor",
                ),
                Panel(
                    "Damaged frames",
                    "On the wires of base and lidar, in a second. More than a few an hour: a loose cable.",
                    ((_rate(f"fognav_serial_errors_total{_R}", "robot", "port"), "{{robot}} {{port}}"),),
                ),
                Panel(
                    "Stops by a late computer",
                    "Stops for which nothing but a delay of the robot's own computer accounts, in ten minutes.",
                    ((f"increase(fognav_late_stops_total{_R}[10m])", "{{robot}}"),),
                ),
            ),
        ),
    ),
    by_robot=True,
)

PIPELINE: Final = Dashboard(
    "fognav-pipeline",
    "Pipeline",
    (
        (
            "From a reading to the wheels",
            (
                Panel(
                    "Stages, 99 of 100 hazards",
                    "How long each stage of a hazard takes at most in 99 of 100 cases of the last five minutes.",
                    (("stage:seconds:p99_5m", "{{stage}}"),),
                    unit="s",
                    width=24,
                    needs="a hazard in the last five minutes",
                ),
                Panel(
                    "Hazards that went through",
                    "Completed stages in a second.",
                    ((_rate("fognav_stage_seconds_count", "stage"), "{{stage}}"),),
                ),
                Panel(
                    "Clocks that differ",
                    "Stages that end before they begin: two computers' clocks differ.",
                    (("sum by (stage) (increase(fognav_trace_skew_total[10m]))", "{{stage}}"),),
                    needs="two computers whose clocks differ",
                ),
            ),
        ),
        (
            "The map",
            (
                Panel(
                    "Versions",
                    "How often the map changes, in a second.",
                    (("rate(fognav_map_seq[$__rate_interval])", "versions"),),
                ),
                Panel(
                    "Gap between heartbeats, 99 of 100",
                    "Sent every 0.1 s; robots slow down after 1 s without one.",
                    (("map_heartbeat:gap_seconds:p99_5m", "p99"),),
                    unit="s",
                ),
                Panel(
                    "Time to make a version",
                    "Mean of each step: combining layers, inflating, packing.",
                    (
                        (
                            _mean("fognav_map_commit_seconds", "step"),
                            "{{step}}",
                        ),
                    ),
                    unit="s",
                ),
                Panel(
                    "Zones",
                    "Drawn by people: stored, and in force now.",
                    (("fognav_zones", "{{state}}"),),
                ),
            ),
        ),
        (
            "The planner",
            (
                Panel(
                    "Plans made",
                    "Searches in a second, by their reason.",
                    ((_rate("fognav_plans_total", "reason"), "{{reason}}"),),
                ),
                Panel(
                    "Plans avoided",
                    "Changes of the map after which a path could stay, in a second.",
                    ((_rate("fognav_plans_avoided_total", "reason"), "{{reason}}"),),
                    needs="a change of the map that concerns no robot",
                ),
                Panel(
                    "Refusals",
                    "Goals that can't be reached, in ten minutes, by their code: "
                    + ", ".join(f"{code} {name}" for code, name in PLAN_CODES.items() if code)
                    + ".",
                    (("sum by (code) (increase(fognav_plan_refusals_total[10m]))", "{{code}}"),),
                    needs="a goal that can't be reached",
                ),
                Panel(
                    "A planning cycle",
                    "Mean time for all robots together.",
                    (
                        (
                            _mean("fognav_plan_cycle_seconds", "process"),
                            "cycle",
                        ),
                    ),
                    unit="s",
                ),
            ),
        ),
    ),
)

SENSORS: Final = Dashboard(
    "fognav-sensors",
    "Sensors",
    (
        (
            "Areas",
            (
                Panel(
                    "State of each area",
                    "blocked, clear or unknown, as announced.",
                    (("fognav_hazards == 1", "{{area}} {{state}}"),),
                    "states",
                    width=24,
                ),
                Panel(
                    "Areas by state",
                    "Unknown areas are treated as their policy says, never as clear.",
                    (("sum by (state) (fognav_hazards)", "{{state}}"),),
                    "stacked",
                ),
                Panel(
                    "Areas that nobody confirms",
                    "As the map sees them: without a living aggregator no area is clear.",
                    (("fognav_areas_unconfirmed", "unconfirmed"),),
                ),
            ),
        ),
        (
            "Readings",
            (
                Panel(
                    "Messages from nodes",
                    "Readings that arrive in a second.",
                    (
                        (
                            _rate('fognav_received_messages_total{process="hazard-aggregator"}', "channel"),
                            "{{channel}}",
                        ),
                    ),
                ),
                Panel(
                    "Silence of each node",
                    "Time since its last reading. Ten come within a second or so after a change, then one a second.",
                    (("fognav_node_silence_seconds", "{{node}} of {{area}}"),),
                    unit="s",
                ),
                Panel(
                    "Nodes that are not believed",
                    "Nothing is known from them: they are silent, or flap.",
                    (
                        ("fognav_node_unknown", "{{node}} of {{area}}: unknown"),
                        ("fognav_node_flapping", "{{node}} of {{area}}: flaps"),
                    ),
                    "states",
                ),
                Panel(
                    "Readings that do not count",
                    "In a second, by node and reason.",
                    (
                        (
                            _rate("fognav_readings_rejected_total", "node", "reason"),
                            "{{node}}: {{reason}}",
                        ),
                    ),
                    needs="a node with implausible or late readings",
                ),
                Panel(
                    "Age of the aggregator's heartbeat",
                    f"Above {AGGREGATOR_HEARTBEAT.max_age_s:g} s no area counts as clear.",
                    (("fognav_aggregator_heartbeat_age_seconds", "age"),),
                    unit="s",
                ),
                Panel(
                    "Refused messages",
                    "Messages that violate their channel's contract, in a second.",
                    (
                        (
                            _rate("fognav_refused_messages_total", "process", "channel"),
                            "{{process}} {{channel}}",
                        ),
                    ),
                    needs="a device that sends what it should not",
                ),
            ),
        ),
    ),
)

FOG_NODE: Final = Dashboard(
    "fognav-fog-node",
    "Fog node",
    (
        (
            "Alive",
            (
                Panel(
                    "Services",
                    "1: it answers.",
                    (('up{job="fog"}', "{{process}}"),),
                    "states",
                ),
                Panel(
                    "Who leads",
                    "Exactly one copy of each service leads.",
                    (('fognav_leader{job="fog"}', "{{process}}"),),
                    "states",
                ),
                Panel(
                    "Conditions",
                    "What each service needs; /readyz says what is missing, and why.",
                    (('fognav_condition{job="fog"}', "{{process}} {{condition}}"),),
                    "states",
                    width=24,
                ),
                Panel(
                    "Alerts",
                    "What an operator should look at; docs/operations.md says what to do.",
                    (('ALERTS{alertstate="firing"}', "{{alertname}} {{robot}}{{process}}{{area}}"),),
                    "states",
                    width=24,
                    needs="something to report",
                ),
            ),
        ),
        (
            "What it costs",
            (
                Panel(
                    "CPU by service",
                    "In cores.",
                    ((_rate('process_cpu_seconds_total{job="fog"}', "process"), "{{process}}"),),
                    "stacked",
                    "percentunit",
                ),
                Panel(
                    "Memory by service",
                    "Resident.",
                    (('process_resident_memory_bytes{job="fog"}', "{{process}}"),),
                    "stacked",
                    "bytes",
                ),
                Panel(
                    "Free part of the disk",
                    "Redis refuses writes when it is full.",
                    (("disk:free:ratio", "{{folder}}"),),
                    unit="percentunit",
                ),
                Panel(
                    "Bytes over zenoh",
                    "In a second, by channel.",
                    (
                        (
                            _rate('fognav_bytes_total{job="fog"}', "channel", "direction"),
                            "{{channel}} {{direction}}",
                        ),
                    ),
                    unit="Bps",
                ),
            ),
        ),
    ),
)

DASHBOARDS: Final = (ROBOTS, PIPELINE, SENSORS, FOG_NODE)
