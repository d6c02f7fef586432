"""Tables of what the nodes said and counted."""

from thermal_fiducial.files.innovations import INNOVATIONS
from thermal_fiducial.report.evaluation import Evaluation
from thermal_fiducial.report.text_table import number, Table

#: Units of the filter's figures, all SI; the others have none, or one in their name.
_UNITS = {
    'seconds since accepted pose': 's',
    'position std': 'm',
    'usable for': 's',
    'time offset': 's',
    'time offset std': 's',
    'white pose error': 'sigma',
    'stamp jitter': 's',
    'mount vibration': 'rad',
    'gyroscope bias': 'rad/s',
    'accelerometer bias': 'm/s^2',
    'gyroscope scale error': '1',
    'accelerometer scale error': '1',
    'map tilt': 'rad',
    'gyroscope noise under vibration': 'rad/s/sqrt(Hz)',
    'accelerometer noise under vibration': 'm/s^2/sqrt(Hz)',
}
#: Figures left out: the table of innovations has them for the whole run, the nodes only for the latest poses.
_ELSEWHERE = ('received ', 'published ', 'poses accepted', 'poses refused', 'NIS per d.o.f.', INNOVATIONS)


def said_table(evaluation: Evaluation) -> Table:
    """What the nodes said, and how often."""
    rows = [(said.node, said.level, said.message, str(said.count)) for said in evaluation.run.output.diagnostics]
    heads = ('node', 'level', 'message', 'times [count]')
    return Table('What the nodes said, once a second', heads, rows, heads[:3])


def load_table(evaluation: Evaluation) -> Table:
    """Processor load of each node."""
    used = evaluation.run.summary.get('cpu_percent', {})
    return Table('Processor load', ('', 'of one core [%]'), [(node, number(value)) for node, value in used.items()])


def figures_tables(evaluation: Evaluation) -> dict[str, Table]:
    """A table of figures for each node, without message counts and those of other tables."""
    said = evaluation.run.summary.get('diagnostics', {})
    heads = ('figure', 'value', 'unit')
    return {
        f'figures of {node}': Table(
            f'{node}, at the end',
            heads,
            [
                _split(name, str(value))
                for name, value in figures.items()
                if value not in ('', '0') and not name.startswith(_ELSEWHERE)
            ],
            heads,
        )
        for node, figures in said.items()
    }


def _split(name: str, value: str) -> tuple[str, str, str]:
    """Name without unit, value and unit of a figure."""
    unit = _UNITS.get(name, 'count' if value.isdigit() else '')
    if name.endswith(']'):
        name, _, unit = name[:-1].rpartition(' [')
    return name, _rounded(value), unit


def _rounded(value: str) -> str:
    """A decimal number with at most four digits and without exponent; other text as it is."""
    try:
        text = number(float(value), 4)
    except ValueError:
        return value
    return text if 'e' in value or len(text) < len(value) else value
