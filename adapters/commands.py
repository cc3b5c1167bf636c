"""Commands of the telemetry side: ``fauio simulate``."""

import argparse
from pathlib import Path
from typing import Any

from adapters.command_line import option, remark, say_json
from adapters.errors import UsageError
from adapters.output_file import check_suffix

SCENARIOS = ("healthy", "undisturbed", "case1", "case2", "case3")
DEFAULT_SCENARIO = "case2"


def add_parsers(subparsers: Any) -> None:
    """Add this package's commands to the command line."""
    simulate = subparsers.add_parser(
        "simulate",
        help="simulate a reference plant, live or into a recording",
        description="Simulate a plant.",
        epilog="example: fauio simulate arm -o arm.mcap --scenario case3",
    )
    plants = simulate.add_subparsers(dest="plant", metavar="PLANT", required=True)
    arm = plants.add_parser(
        "arm",
        help="single-link flexible-joint arm",
        description="Simulate the flexible-joint arm with known faults (f_a on the torque, f_s on the motor angle's "
        "sensor) and publish its telemetry live, or record it.",
        epilog="example: fauio simulate arm --zenoh arm/telemetry --fault f_a:step:10:20:0.5 --duration 30",
    )
    target = arm.add_mutually_exclusive_group(required=True)
    option(target, "--zenoh KEY", "publish JSON over Zenoh under this key")
    option(target, "--mavlink URL", "send MAVLink over UDP to udpout:HOST:PORT")
    option(target, "-o --output OUT.mcap", "write a recording", Path)
    option(
        arm,
        "--connect ENDPOINT",
        "Zenoh endpoints to connect to (default tcp/127.0.0.1:7447, where the daemon listens)",
        nargs="+",
    )
    option(arm, "--zenoh-config FILE", "Zenoh configuration with certificates or password; its endpoints are used")
    arm.add_argument(
        "--scenario",
        choices=SCENARIOS,
        help=f"faults and disturbances of the paper (default {DEFAULT_SCENARIO}; healthy with --fault)",
    )
    option(
        arm,
        "--fault CHANNEL:KIND:START:STOP:SIZE[:HZ]",
        "add a fault: channel f_a or f_s; kind step, ramp or sine; times in seconds; may be repeated",
        action="append",
        default=[],
    )
    arm.add_argument(
        "--torque", choices=("zero", "tracking"), default="zero", help="no torque, or a torque that swings the link"
    )
    option(arm, "--duration S", "simulated seconds (default 50)", float, default=50.0)
    option(arm, "--rate HZ", "samples per second (default 100)", float, default=100.0)
    option(arm, "--speed X", "speed relative to real time (default 1)", float, default=1.0)
    option(arm, "--json", "print a summary as one JSON object")
    arm.set_defaults(handler=_simulate_arm)


def _simulate_arm(args: argparse.Namespace) -> int:
    import time

    from adapters.simulation.arm import SCENARIOS as KNOWN
    from adapters.simulation.arm import ArmScenario, parse_fault, simulate_arm
    from adapters.zenoh.zenoh_session import DEFAULT_ENDPOINT

    name = args.scenario or ("healthy" if args.fault else DEFAULT_SCENARIO)
    base = KNOWN[name]
    scenario = ArmScenario((*base.faults, *(parse_fault(text) for text in args.fault)), base.disturbed)
    if (args.connect or args.zenoh_config) and not args.zenoh:
        raise UsageError(f"{'--connect' if args.connect else '--zenoh-config'} goes with --zenoh only")
    if args.output:
        check_suffix(args.output, ".mcap")
    run = simulate_arm(scenario, args.duration, args.rate, args.torque)
    if args.output:
        from adapters.logs.mcap_log import MessageLogWriter
        from adapters.simulation.arm_source import arm_messages

        sent = 0
        with MessageLogWriter(args.output) as log:
            for message in arm_messages(run, time.time_ns()):
                log.write(message)
                sent += 1
    elif args.mavlink:
        from adapters.simulation.arm_source import send_arm

        sent = send_arm(run, args.mavlink, args.speed)
    else:
        from adapters.simulation.arm_source import publish_arm

        sent = publish_arm(run, args.zenoh, args.connect or [DEFAULT_ENDPOINT], args.speed, args.zenoh_config)
    target = str(args.output or args.mavlink or args.zenoh)
    summary = {
        "scenario": name,
        "faults": [{"channel": f.channel, "start_s": f.start_s, "stop_s": f.stop_s} for f in scenario.faults],
        "duration_s": args.duration,
        "rate_hz": args.rate,
        "samples": len(run.t),
        "messages": sent,
        "to": target,
    }
    if args.json:
        say_json(summary)
    else:
        remark(f"{len(run.t)} samples of the arm, scenario {name}: {sent} messages to {target}")
    return 0
