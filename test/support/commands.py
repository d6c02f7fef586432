"""Commands whose arguments are wrong."""

from thermal_fiducial.cli.main import main


def status(words):
    """Exit status, also where the parser ends the process."""
    try:
        return main([str(word) for word in words])
    except SystemExit as ended:
        return ended.code
