"""The run loop of all nodes."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from functools import partial
import os
from pathlib import Path
import sys
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.exceptions import NameValidationException, ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.logging import get_logger
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import ok, remove_ros_args, try_shutdown

from thermal_fiducial.errors import InputError
from thermal_fiducial.ros.base import params
from thermal_fiducial.ros.base.node import Made, StageNode
from thermal_fiducial.ros.process.low_latency import keep_for_good, take_priority
from thermal_fiducial.ros.process.nonblocking_output import drop_what_does_not_fit, say_last
from thermal_fiducial.ros.process.stale_shared_memory import remove_stale_memory
from thermal_fiducial.ros.process.stopping import limit_the_end, release_the_end, StopSignals

PROFILE = Path(__file__).with_name('fastdds.xml')
#: Environment variables of Fast DDS 2 (Jazzy) and Fast DDS 3.
_PROFILE_VARIABLES = ('FASTRTPS_DEFAULT_PROFILES_FILE', 'FASTDDS_DEFAULT_PROFILES_FILE')


class _DeafError(Exception):
    """DDS has left the node deaf."""


def use_transport_profile() -> None:
    """Let Fast DDS send images through shared memory, unless the user has a profile; call before ``rclpy.init``."""
    if not any(os.environ.get(name) for name in _PROFILE_VARIABLES):
        os.environ.update(dict.fromkeys(_PROFILE_VARIABLES, str(PROFILE)))


def limit_opencv() -> None:
    """Let OpenCV, if it is loaded, work on one thread, or on as many as the user's ``OPENCV_FOR_THREADS_NUM`` says.

    Where it is built with TBB, as Ubuntu's is, it does not read that variable.
    """
    if (opencv := sys.modules.get('cv2')) is not None:
        opencv.setNumThreads(int(os.environ.get('OPENCV_FOR_THREADS_NUM') or 1))


def make_executor(context: Context | None = None) -> Any:
    """EventsExecutor (22 us a callback) if this rclpy has it, else SingleThreadedExecutor (96 us).

    Never the MultiThreadedExecutor: it loses two thirds of a 200 Hz stream.
    """
    try:
        from rclpy.experimental.events_executor import EventsExecutor
    except ImportError:
        return SingleThreadedExecutor(context=context)
    return EventsExecutor(context=context)


#: What to do about an error of rcl, by a part of its message.
_HINTS = {
    'Sequence should be of same type': ': among decimal numbers write 0.0 for 0',
    '__ns:=': ': a namespace begins with a slash, as /drone1',
}
#: The same for names of a node and its topics.
_HINTS_OF_NAMES = {
    'invalid node name': ': a namespace is as /drone1, without a slash at its end',
    'topic length': ': a namespace or another name is too long',
}

#: Arguments of what runs for a command and not on a robot: no files in ~/.ros/log, which may not be writable.
OF_A_COMMAND = ('--ros-args', '--disable-external-lib-logs')


def initialise(
    args: Sequence[str] | None,
    context: Context | None = None,
    domain_id: int | None = None,
    signals: SignalHandlerOptions | None = None,
) -> None:
    """``rclpy.init`` that raises :class:`InputError` for bad arguments or parameter files.

    Where no log file can be written it goes on without: on a disk that has become read-only, a node that crashed in
    flight is still to be started again.

    Raises
    ------
    InputError
        Arguments or a parameter file that ROS cannot read.
    """
    use_transport_profile()
    try:
        rclpy.init(
            args=None if args is None else list(args),
            context=context,
            domain_id=domain_id,
            signal_handler_options=signals,
        )
    except RuntimeError as error:
        # The log file comes last.
        if ok(context=context):
            line = f'no log file: {_first_line(error)}; ROS_LOG_DIR names another folder'
            get_logger('thermal_fiducial').warning(line)
            return
        if _is_secured() and not os.environ.get('ROS_SECURITY_KEYSTORE'):
            raise InputError('ROS_SECURITY_ENABLE is true, and ROS_SECURITY_KEYSTORE is not set') from None
        raise InputError(_first_line(error) + _hint(error, _HINTS)) from None


def _is_secured() -> bool:
    return os.environ.get('ROS_SECURITY_ENABLE', '') == 'true'


def _hint(error: Exception, hints: Mapping[str, str]) -> str:
    return next((hint for part, hint in hints.items() if part in str(error)), '')


def _first_line(error: Exception) -> str:
    """The message of rcl, without its source line."""
    line = str(error).splitlines()[0].removeprefix('failed to initialize rcl: ')
    return line.partition(', at /')[0].removesuffix(':')


def run(make_node: Callable[[], StageNode[Any]], args: Sequence[str] | None = None) -> int:
    """Run a node until it is asked to stop; one that DDS has left deaf is started again in place of this process.

    Parameters
    ----------
    make_node : constructor of the node
    args : ROS arguments; default: the command line

    Returns
    -------
    Exit status: 0 stopped, 2 unusable arguments or parameters, or a map that cannot be saved (one line says which).
    """
    drop_what_does_not_fit()
    limit_opencv()
    stop = StopSignals(try_shutdown)
    try:
        _make_and_spin(make_node, args, stop)
    except _DeafError:
        # It may have been asked to stop while it saved a map.
        if not stop.asked:
            _start_again()
    except InputError as error:
        say_last(f'{Path(sys.argv[0]).name}: {error}')
        return 2
    finally:
        stop.ignore()
    return 0


def _start_again() -> None:
    """Replace this process: nobody else would do it for ``ros2 run``, and launch would wait for a second."""
    release_the_end()
    os.execv(sys.executable, sys.orig_argv)


def _make_and_spin(make_node: Callable[[], StageNode[Any]], args: Sequence[str] | None, stop: StopSignals) -> None:
    """Run a node to its orderly end.

    Raises
    ------
    _DeafError
        The node is to be started again.
    """
    # Saving comes first in the shutdown, before steps that may fail or hang.
    with ExitStack() as ending:
        ending.callback(try_shutdown)
        try:
            remove_stale_memory()
            initialise(args, signals=SignalHandlerOptions.NO)
            _refuse_others(args)
            node = made(make_node)
            ending.callback(node.destroy_node)
            node.remark(params.doubts_of_files(node.get_fully_qualified_name(), sys.argv if args is None else args))
            executor = make_executor()
            ending.callback(executor.shutdown)
            ending.push(limit_the_end)
            ending.push(partial(_close, node))
            executor.add_node(node)
            # A stop request shuts the context down, which the executor reports.
            with suppress(ExternalShutdownException):
                _spin(node, executor, stop)
            if node.deaf and not stop.asked:
                raise _DeafError
            node.finish()
        except (InputError, _DeafError):
            raise
        except Exception:
            # A stop request during construction makes rcl fail: not an error of the node.
            if ok() and not stop.asked:
                raise
            limit_the_end()


def _close(node: StageNode[Any], crashed: type[BaseException] | None, *_: object) -> None:
    """Close the node; where it ``crashed`` or is deaf that stays the reason of its end, so that it is started again."""
    try:
        node.close()
    except InputError as error:
        if crashed is None:
            raise
        node.get_logger().error(str(error))


def made(make_node: Callable[[], Made], context: Context | None = None) -> Made:
    """The node in ``context``; InputError if SROS2 denies it, or rclpy its names or parameters: it is not restarted."""
    try:
        return make_node()
    except ParameterException as error:
        # Of use_sim_time, which rclpy declares before ours.
        raise InputError(str(error)) from None
    except (RuntimeError, NameValidationException) as error:
        if _is_secured() and ok(context=context):
            raise InputError(f'ROS_SECURITY_ENABLE is true: {_first_line(error)}') from None
        if hint := _hint(error, _HINTS_OF_NAMES):
            raise InputError(_first_line(error) + hint) from None
        raise


def _refuse_others(args: Sequence[str] | None) -> None:
    """Refuse arguments that ROS would ignore silently, such as all after a mistyped ``--ros-args``."""
    others = remove_ros_args(sys.argv)[1:] if args is None else remove_ros_args(list(args))
    if others:
        raise InputError(f'argument {others[0]}: a node has none but those behind --ros-args')


def _spin(node: StageNode[Any], executor: Any, stop: StopSignals) -> None:
    keep_for_good()
    if node.realtime_priority and not take_priority(node.realtime_priority):
        node.get_logger().info('no real-time priority: this user may not')
    # EventsExecutor.spin() and spin_once(None) run no callbacks on some builds.
    while ok() and not (stop.asked or node.deaf):
        executor.spin_once(timeout_sec=1.0)
