"""Commands that put faults into recordings: inject, detectability."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from adapters.command_line import finite, natural, positive, say, say_json, several
from replay.runs.replay_command import LOG_HELP

_KINDS = ("bias", "ramp", "scale", "freeze", "replay", "noise", "delay", "drop", "spoof", "loss")
_INJECT_TEXT = """\
Put a fault or attack of known size into a recording. Times are seconds of the vehicle's own clock since its first
stamp in the log (--at-ms: that clock itself). Measurements are altered by their stamps, not by their arrival.
OUT.truth.json and the metadata record 'truth' say what was altered, and when.

kinds:
  bias    adds --size
  ramp    adds --rate per second, up to --size
  scale   multiplies by --size
  noise   adds noise with a standard deviation of --size
  freeze  holds the last value
  replay  repeats what was recorded from --from to the start
  delay   shows the value of --size seconds ago
  drop    loses the messages, or a share --size of them
  spoof   moves GPS position and velocity together: up to --rate m/s, with
          at most --accel m/s^2
  loss    an actuator of --profile delivers a share --size less, at once or
          growing by --rate per second. The autopilot compensates: its command
          grows until the motor delivers the same thrust, and the motion stays
          as recorded. If full command is not enough, and for other plants, the
          plant's linear response is added to the measurements

channels:
  gps_north gps_east gps_down (m), gps_velocity_north gps_velocity_east
  airspeed (m/s), baro (m of altitude), compass attitude_roll attitude_pitch
  (rad), gyro_x gyro_y gyro_z (rad/s), accel_x accel_y accel_z (m/s^2): in
  all messages that carry them; the faults of --profile's model;
  MESSAGE.field for any other number, in the field's own unit
"""


def add_parsers(subparsers: Any) -> None:
    """Add the commands to the command line."""
    _add_inject(subparsers)
    _add_detectability(subparsers)


def _add_inject(subparsers: Any) -> None:
    parser = subparsers.add_parser(
        "inject",
        help="put a fault or attack of known size into a recording",
        description=_INJECT_TEXT,
        epilog="example: fauio inject flight.tlog --channel baro --kind bias --size 8 --start 30 -o out.mcap",
    )
    parser.add_argument("log", type=Path, metavar="LOG", help=LOG_HELP)
    parser.add_argument("--channel", required=True, metavar="NAME", help="channel to alter (see above)")
    parser.add_argument("--kind", required=True, metavar="KIND", help=", ".join(_KINDS))
    begin = parser.add_mutually_exclusive_group(required=True)
    begin.add_argument("--start", type=float, metavar="S", help="begin, seconds since the log's first stamp")
    begin.add_argument("--at-ms", type=int, metavar="MS", help="begin, milliseconds of the vehicle's clock")
    finish = parser.add_mutually_exclusive_group()
    finish.add_argument("--end", type=float, metavar="S", help="end, counted as --start (default: the log's end)")
    finish.add_argument("--for", type=float, metavar="S", dest="duration", help="how long it lasts, seconds")
    parser.add_argument(
        "--size",
        type=float,
        metavar="X",
        help="size in the channel's unit (see above); seconds for a delay; a share for a loss",
    )
    parser.add_argument(
        "--rate", type=float, metavar="X", help="growth in the channel's unit per second; m/s for a spoof"
    )
    parser.add_argument("--accel", type=float, metavar="X", help="largest acceleration of a spoof, m/s^2 (0.5)")
    parser.add_argument(
        "--from", type=float, metavar="S", dest="source", help="begin of the replayed segment (seconds, as --start)"
    )
    parser.add_argument("--seed", type=natural, default=0, metavar="N", help="seed of noise and lost messages (0)")
    parser.add_argument("--system", type=natural, default=0, metavar="N", help="MAVLink system (default: first sender)")
    parser.add_argument("--profile", type=Path, metavar="PROFILE", help="profile folder with the vehicle's model")
    parser.add_argument("-o", "--out", required=True, type=Path, metavar="OUT.mcap", help="file to write")
    parser.add_argument("--json", action="store_true", help="print the truth as one JSON object")
    parser.set_defaults(handler=run_inject)


def _add_detectability(subparsers: Any) -> None:
    parser = subparsers.add_parser(
        "detectability",
        help="measure which size of fault is detected, and how fast",
        description="Put faults of several kinds and sizes into a healthy recording at several times, run the monitor "
        "on each, and report how many are missed, how fast the others are detected, and which other alarms are raised. "
        "A loss is injected by the profile's own model, so errors of the model do not show.",
        epilog="example: fauio detectability quad/ healthy.tlog --channel motor1 --sizes 0.02,0.1",
    )
    parser.add_argument("profile", type=Path, metavar="PROFILE", help="profile folder")
    parser.add_argument("log", type=Path, metavar="LOG", help=LOG_HELP + "; without faults")
    parser.add_argument(
        "--channel",
        action="append",
        metavar="NAME",
        help="alarm channel, may be repeated (default: all, which takes minutes)",
    )
    parser.add_argument(
        "--kinds",
        type=several,
        metavar="K,K",
        help="kinds of fault (default: loss of actuators, bias and ramp of sensors)",
    )
    parser.add_argument(
        "--sizes",
        type=lambda text: tuple(map(finite, several(text))),
        metavar="X,X",
        help="sizes in the channel's unit; rates per second for ramp and spoof (default: around the threshold)",
    )
    parser.add_argument("--onsets", type=positive, default=5, metavar="N", help="number of onsets for each size (5)")
    parser.add_argument(
        "--before", type=float, default=10.0, metavar="S", help="healthy flight before each onset, seconds (10)"
    )
    parser.add_argument(
        "--after",
        type=float,
        default=10.0,
        metavar="S",
        help="a fault not detected within these seconds is missed (10)",
    )
    parser.add_argument("--jobs", type=positive, default=1, metavar="N", help="processes (1)")
    parser.add_argument("--plot", type=Path, metavar="OUT.png", help="plot delay and miss rate against size")
    parser.add_argument("--json", action="store_true", help="print the result as one JSON object")
    parser.set_defaults(handler=run_detectability)


def run_inject(args: argparse.Namespace) -> int:
    """Run ``fauio inject``."""
    from monitor.fitting.progress import track
    from replay.attacks.attack import Attack
    from replay.attacks.inject import Order, inject_recording, truth_path

    attack = Attack(args.channel, args.kind, 0, 0, args.size, args.rate, args.accel, seed=args.seed)
    order = Order(attack, args.start, args.at_ms, args.end, args.duration, args.source, args.system)
    truth = inject_recording(args.log, args.out, order, args.profile, track)
    if args.json:
        say_json(truth)
        return 0
    fault = truth["faults"][-1]
    span = f"{fault['on']['time_boot_ms']} to {fault['off']['time_boot_ms']} ms of the vehicle's clock"
    say(f"{args.out}: {fault['target']} {fault['kind']}, {fault['meaning']}, {span}, {fault['messages']} messages")
    say(f"{truth_path(args.out)}: the truth")
    return 0


def run_detectability(args: argparse.Namespace) -> int:
    """Run ``fauio detectability``."""
    from adapters.output_file import check_suffix
    from monitor.fitting.progress import track
    from replay.runs.log_list import check_output
    from replay.sensitivity.detectability import Sweep, detectability, result_json, result_lines

    if args.plot:
        check_suffix(args.plot, ".png")
        check_output(args.plot)
    sweep = Sweep(
        channels=tuple(args.channel or ()),
        kinds=args.kinds,
        sizes=args.sizes,
        onsets=args.onsets,
        before_s=args.before,
        after_s=args.after,
        jobs=args.jobs,
    )
    result = detectability(args.profile, args.log, sweep, track)
    if args.json:
        say_json(result_json(result))
    else:
        say(*result_lines(result))
    if args.plot:
        from replay.sensitivity.detectability_plot import plot_detectability

        plot_detectability(args.plot, result)
    return 0
