"""Field for a number in the page."""

from nicegui import ui


class NumberField(ui.number):
    """A field for a number that keeps what was typed.

    NiceGUI's field is rewritten when it loses the focus, possibly with a number older than what was typed before the
    page was connected.
    """

    def sanitize(self) -> None:
        """Do nothing: limits are checked where the number is used."""
