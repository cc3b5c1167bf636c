"""The commands that put faults into recordings: inject, detectability."""

import argparse
from pathlib import Path
from typing import Any

from adapters.command_line import finite, natural, option, positive, say, say_json, several
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
    option(parser, "log LOG", LOG_HELP, Path)
    option(parser, "--channel NAME", "channel to alter (see above)", required=True)
    option(parser, "--kind KIND", ", ".join(_KINDS), required=True)
    begin = parser.add_mutually_exclusive_group(required=True)
    option(begin, "--start S", "begin, seconds since the log's first stamp", float)
    option(begin, "--at-ms MS", "begin, milliseconds of the vehicle's clock", int)
    finish = parser.add_mutually_exclusive_group()
    option(finish, "--end S", "end, counted as --start (default: the log's end)", float)
    option(finish, "--for S", "how long it lasts, seconds", float, dest="duration")
    option(parser, "--size X", "size in the channel's unit (see above); seconds for a delay; a share for a loss", float)
    option(parser, "--rate X", "growth in the channel's unit per second; m/s for a spoof", float)
    option(parser, "--accel X", "largest acceleration of a spoof, m/s^2 (0.5)", float)
    option(parser, "--from S", "begin of the replayed segment (seconds, as --start)", float, dest="source")
    option(parser, "--seed N", "seed of noise and lost messages (0)", natural, default=0)
    option(parser, "--system N", "MAVLink system (default: first sender)", natural, default=0)
    option(parser, "--profile PROFILE", "profile folder with the vehicle's model", Path)
    option(parser, "-o --out OUT.mcap", "file to write", Path, required=True)
    option(parser, "--json", "print the truth as one JSON object")
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
    option(parser, "profile PROFILE", "profile folder", Path)
    option(parser, "log LOG", LOG_HELP + "; without faults", Path)
    option(
        parser, "--channel NAME", "alarm channel, may be repeated (default: all, which takes minutes)", action="append"
    )
    option(parser, "--kinds K,K", "kinds of fault (default: loss of actuators, bias and ramp of sensors)", several)
    option(
        parser,
        "--sizes X,X",
        "sizes in the channel's unit; rates per second for ramp and spoof (default: around the threshold)",
        lambda text: tuple(map(finite, several(text))),
    )
    option(parser, "--onsets N", "number of onsets for each size (5)", positive, default=5)
    option(parser, "--before S", "healthy flight before each onset, seconds (10)", float, default=10.0)
    option(parser, "--after S", "a fault not detected within these seconds is missed (10)", float, default=10.0)
    option(parser, "--jobs N", "processes (1)", positive, default=1)
    option(parser, "--plot OUT.png", "plot delay and miss rate against size", Path)
    option(parser, "--json", "print the result as one JSON object")
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
