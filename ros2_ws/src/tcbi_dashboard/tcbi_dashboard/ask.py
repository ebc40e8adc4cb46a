"""A question before something is made: what it will make, and buttons that say what each of them does."""

from collections.abc import Callable, Sequence

from nicegui import ui

from tcbi_dashboard.elements import window, words


def ask(title: str, sentences: Sequence[str], answers: Sequence[tuple[str, Callable[[], None]]]) -> None:
    """Show a small dialog; the first answer stands out, and one may always leave without any.

    Args:
      title: the question.
      sentences: what will be made.
      answers: label and what is then done.
    """

    def answered(action: Callable[[], None]) -> None:
        dialog.close()
        action()

    with window("max-width: 34rem") as dialog:
        words(title, "h2")
        for sentence in sentences:
            words(sentence)
        with ui.element("div").classes("tcbi-row"):
            for i, (label, action) in enumerate(answers):
                ui.button(label, on_click=lambda action=action: answered(action)).props("outline" if i else "")
            ui.button("Cancel", on_click=dialog.close).props("flat")
