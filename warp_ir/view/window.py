"""A window of VTK that shows pictures and passes on events; and the view in it."""

import ctypes
import ctypes.util
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from warp_ir.scene import InputError
from warp_ir.view.access import NO_DISPLAY
from warp_ir.view.controls import Controls
from warp_ir.view.display import Pixels
from warp_ir.view.session import Frame, LiveView

_IDLE_SECONDS = 0.01
"""Time between two looks at the events of a window in which nothing happens [s]."""
_WINDOWS = ("vtkXOpenGLRenderWindow", "vtkWin32OpenGLRenderWindow", "vtkCocoaRenderWindow")
"""Classes of windows on a screen: without one VTK makes others, which nobody sees."""
_KEYS = {"Prior": "PageUp", "Next": "PageDown", "plus": "+", "minus": "-", "KP_Add": "+", "KP_Subtract": "-"}
"""Our names of keys for those of X11."""
_FONT_SIZE = 12
_BUTTONS = ("Left", "Middle", "Right")
_TITLE_PIXELS = 12
"""Height of the titles of sliders."""
_leaked: list[object] = []
"""Windows of a display that is gone: destroying them would talk to it."""


class PictureWindow:
    """A window whose whole area is a picture, with text on it."""

    def __init__(self, title: str, width: int, height: int) -> None:
        """Opens the window.

        Raises:
            InputError: There is no display.
        """
        try:
            import vtkmodules.vtkInteractionStyle
            import vtkmodules.vtkRenderingFreeType
            import vtkmodules.vtkRenderingOpenGL2
            import vtkmodules.vtkRenderingUI  # noqa: F401
            from vtkmodules.util.numpy_support import numpy_to_vtk
            from vtkmodules.vtkCommonCore import vtkLogger
            from vtkmodules.vtkCommonDataModel import vtkImageData
            from vtkmodules.vtkRenderingCore import (
                vtkRenderer,
                vtkRenderWindow,
                vtkRenderWindowInteractor,
                vtkTextActor,
                vtkTexture,
            )
        except ImportError as error:  # libGL is missing, for example
            raise InputError(f"no window: {error}") from None
        self._to_vtk: Any = numpy_to_vtk
        self._image_type = vtkImageData
        self.lost = False
        """Whether the display is gone: VTK must not be used any more."""
        self._shown: object = None
        vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)  # our own message says it
        self.window: Any = vtkRenderWindow()
        if self.window.GetClassName() not in _WINDOWS:
            raise InputError(NO_DISPLAY)
        self.window.SetWindowName(title)
        self.window.SetSize(width, height)
        self.renderer: Any = vtkRenderer()
        self.renderer.SetBackground(0.0, 0.0, 0.0)
        self.renderer.TexturedBackgroundOn()
        self.window.AddRenderer(self.renderer)
        self._texture: Any = vtkTexture()
        self._texture.InterpolateOn()
        self._texts: list[Any] = []
        for _ in range(2):
            actor = vtkTextActor()
            style = actor.GetTextProperty()
            style.SetFontFamilyToCourier()
            style.SetFontSize(_FONT_SIZE)
            style.SetColor(1.0, 1.0, 1.0)
            style.SetBackgroundColor(0.0, 0.0, 0.0)
            style.SetBackgroundOpacity(0.6)
            style.SetLineSpacing(1.1)
            self.renderer.AddViewProp(actor)
            self._texts.append(actor)
        self._texts[1].GetTextProperty().SetVerticalJustificationToTop()
        self.interactor: Any = vtkRenderWindowInteractor()
        self.interactor.SetRenderWindow(self.window)
        self.interactor.SetInteractorStyle(None)  # type: ignore[arg-type]  # its keys would end the program
        self.interactor.Initialize()
        self._survive_a_lost_display()
        self.window.Render()

    def _survive_a_lost_display(self) -> None:
        """Has Xlib tell when the connection breaks, where it would end the process."""
        if not self.window.GetClassName().startswith("vtkX"):
            return
        library = ctypes.util.find_library("X11")
        address = str(self.window.GetGenericDisplayId()).strip("_").split("_")[0]
        if library is None or not address:
            return
        xlib = ctypes.CDLL(library)
        handler = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)(self._display_lost)
        quiet = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p)(lambda _: 0)
        _leaked.extend((handler, quiet))
        if hasattr(xlib, "XSetIOErrorExitHandler"):  # since libX11 1.7
            xlib.XSetIOErrorHandler(quiet)
            xlib.XSetIOErrorExitHandler(ctypes.c_void_p(int(address, 16)), handler, None)

    def _display_lost(self, *_: object) -> None:
        self.lost = True
        _leaked.append(self.__dict__.copy())

    @property
    def size(self) -> tuple[int, int]:
        """Width and height [pixels]."""
        width, height = self.window.GetSize()
        return max(int(width), 1), max(int(height), 1)

    def show(self, pixels: Pixels) -> None:
        """Takes over a picture, scaled to the window, for the next `render`."""
        height, width = pixels.shape[:2]
        flipped = np.ascontiguousarray(pixels[::-1]).reshape(-1, 3)
        image: Any = self._image_type()
        image.SetDimensions(width, height, 1)
        image.GetPointData().SetScalars(self._to_vtk(flipped))
        self._shown = flipped, image
        self._texture.SetInputData(image)
        self.renderer.SetBackgroundTexture(self._texture)

    def write(self, lines: Sequence[str], block: int = 0) -> None:
        """Writes text in the lower left corner (block 0) or the upper left (1); no lines: none."""
        actor = self._texts[block]
        actor.SetInput("\n".join(lines))
        actor.SetVisibility(bool(lines))
        actor.SetPosition(8, 8 if block == 0 else self.size[1] - 8)

    def render(self) -> None:
        """Draws the window."""
        if not self.lost:
            self.window.Render()

    def pump(self) -> bool:
        """Handles the events that have arrived; False if the window is closed or lost."""
        if not self.lost:
            self.interactor.ProcessEvents()
        return not (self.lost or self.interactor.GetDone())

    def close(self) -> None:
        """Closes the window."""
        if not self.lost:
            self.window.Finalize()
            self.interactor.TerminateApp()


class ViewWindow:
    """A `LiveView` in a window: events to `Controls`, frames to the screen."""

    def __init__(self, view: LiveView, controls: Controls, title: str) -> None:
        """Opens the window.

        Raises:
            InputError: There is no display.
        """
        self.view, self.controls = view, controls
        self.picture = PictureWindow(title, view.state.width, view.state.height)
        self._frame: Frame | None = None
        self._new: Frame | None = None
        self._error: BaseException | None = None
        self._sliders: list[Any] = []
        self._text: tuple[Any, ...] = ()
        self.shown = 0
        """Number of frames that were drawn."""
        interactor = self.picture.interactor
        for button in _BUTTONS:
            interactor.AddObserver(f"{button}ButtonPressEvent", self._pressing(button.lower()))
            interactor.AddObserver(f"{button}ButtonReleaseEvent", lambda *_: controls.release())
        interactor.AddObserver("MouseMoveEvent", lambda *_: controls.drag(*self._place()))
        interactor.AddObserver("MouseWheelForwardEvent", lambda *_: controls.wheel(1.0))
        interactor.AddObserver("MouseWheelBackwardEvent", lambda *_: controls.wheel(-1.0))
        interactor.AddObserver("KeyPressEvent", lambda *_: self._key(True))
        interactor.AddObserver("KeyReleaseEvent", lambda *_: self._key(False))
        interactor.AddObserver("LeaveEvent", lambda *_: controls.forget_keys())

    def run(self, on_frame: Callable[["ViewWindow"], None] | None = None) -> None:
        """Shows the view until its window is closed.

        Args:
            on_frame: Called after every frame that was drawn.

        Raises:
            InputError: The display is gone.
        """
        worker = threading.Thread(target=self._work, name="view", daemon=True)
        worker.start()
        try:
            while self._step():
                if on_frame is not None:
                    on_frame(self)
        finally:
            self.view.close()
            worker.join()
            if not self.picture.lost:
                self.picture.close()
        if self._error is not None:
            raise self._error
        if self.picture.lost:
            raise InputError("the display is gone")

    def _work(self) -> None:
        try:
            self.view.run(self._take)
        except BaseException as error:  # raised again in the thread of the window
            self._error = error

    def _take(self, frame: Frame) -> None:
        with self.view.changed:
            self._new = frame
            self.view.changed.notify_all()

    def _step(self) -> bool:
        """Handles events, and draws what is new; False at the end."""
        picture, controls = self.picture, self.controls
        if not picture.pump() or controls.closed or self._error is not None:
            return False
        self.view.resize(*picture.size)
        controls.tick()
        frame, self._new = self._new, None
        if frame is not None:
            self._frame = frame
            picture.show(frame.pixels)
        help_lines = tuple(controls.help_lines()) if controls.show_help else ()
        text = (tuple(controls.status(self._frame)), help_lines, picture.size, controls.surface, controls.show_panel)
        if frame is None and text == self._text:
            with self.view.changed:
                if self._new is None:
                    self.view.changed.wait(_IDLE_SECONDS)
            return not picture.lost
        if text != self._text:
            picture.write(text[0], 0)
            picture.write(text[1], 1)
            self._text = text
            self._update_sliders()
        picture.render()
        self.shown += frame is not None
        return not picture.lost

    def _place(self) -> tuple[float, float]:
        """Where the pointer is, as fractions of the window from its upper left corner."""
        x, y = self.picture.interactor.GetEventPosition()
        width, height = self.picture.size
        return (x + 0.5) / width, 1.0 - (y + 0.5) / height

    def _pressing(self, button: str) -> Callable[..., None]:
        def press(*_: object) -> None:
            column, row = self._place()
            if button == "left" and self.picture.interactor.GetControlKey():
                self.controls.pick(column, row)
            else:
                shift = bool(self.picture.interactor.GetShiftKey())
                self.controls.press(button, column, row, shift=shift)

        return press

    def _key(self, pressed: bool) -> None:
        symbol = str(self.picture.interactor.GetKeySym() or "")
        code = str(self.picture.interactor.GetKeyCode() or "")
        printable = len(code) == 1 and code.isprintable() and code != " "
        name = code if printable else _KEYS.get(symbol, symbol)
        if name == "p" and pressed:
            self.controls.pick(*self._place())
        else:
            self.controls.key(name, pressed=pressed)

    # Sliders

    def _add_sliders(self) -> None:
        """Exposure, bounces and the light on the right; red, green and blue of a surface once one is picked."""
        from vtkmodules.vtkInteractionWidgets import vtkSliderRepresentation2D, vtkSliderWidget

        controls, view = self.controls, self.view

        def bounces(value: float) -> None:
            view.change(max_bounces=None if value > 9.5 else round(value))

        def gain(stops: float) -> None:
            if controls.light:
                view.edit_light(controls.light, gain=2.0**stops, on=True)

        def channel(k: int) -> Callable[[float], None]:
            def paint(value: float) -> None:
                color = list(controls.color)
                color[k] = value
                controls.paint((color[0], color[1], color[2]))

            return paint

        for k, (title, low, high, change) in enumerate(
            (
                ("exposure", -8.0, 8.0, lambda value: view.change(exposure=value, auto_exposure=False)),
                ("bounces", 0.0, 10.0, bounces),
                ("light, stops", -6.0, 6.0, gain),
                ("red", 0.0, 1.0, channel(0)),
                ("green", 0.0, 1.0, channel(1)),
                ("blue", 0.0, 1.0, channel(2)),
            )
        ):
            shape: Any = vtkSliderRepresentation2D()
            shape.SetMinimumValue(low)
            shape.SetMaximumValue(high)
            shape.SetTitleText(title)
            shape.SetLabelFormat("%.2g")
            for point, x in ((shape.GetPoint1Coordinate(), 0.78), (shape.GetPoint2Coordinate(), 0.97)):
                point.SetCoordinateSystemToNormalizedDisplay()
                point.SetValue(x, 0.92 - 0.14 * k)
            shape.SetSliderLength(0.02)
            shape.SetSliderWidth(0.025)
            shape.SetTubeWidth(0.005)
            shape.SetEndCapLength(0.0)
            widget: Any = vtkSliderWidget()
            widget.SetInteractor(self.picture.interactor)
            widget.SetRepresentation(shape)
            widget.SetAnimationModeToJump()
            widget.AddObserver("InteractionEvent", lambda w, _, act=change: act(w.GetRepresentation().GetValue()))
            self._sliders.append(widget)

    def _update_sliders(self) -> None:
        """Shows the sliders that are wanted, at the values of the view; those of a colour once a surface is picked."""
        state, controls = self.view.state, self.controls
        if not self._sliders and (controls.show_panel or controls.surface):
            self._add_sliders()
        edit, height = state.edits.light(controls.light), max(self.picture.size[1], _TITLE_PIXELS)
        values = [
            state.exposure,
            10.0 if state.max_bounces is None else float(state.max_bounces),
            float(np.log2(max(edit.gain, 1e-6))),
            *controls.color,
        ]
        for k, (widget, value) in enumerate(zip(self._sliders, values, strict=False)):
            wanted = bool(controls.surface) if k >= 3 else controls.show_panel
            if bool(widget.GetEnabled()) != wanted:
                widget.SetEnabled(wanted)
            shape = widget.GetRepresentation()
            shape.SetValue(value)
            shape.SetTitleHeight(_TITLE_PIXELS / height)
            shape.SetLabelHeight(_TITLE_PIXELS / height)


def show_view(view: LiveView, controls: Controls, title: str) -> None:
    """Shows a view in a window until it is closed.

    Raises:
        InputError: There is no display, or it is lost.
    """
    ViewWindow(view, controls, title).run()


def wait_for_frame(window: ViewWindow, seconds: float) -> bool:
    """Whether another frame was drawn within some seconds; for tests and measurements."""
    shown, end = window.shown, time.perf_counter() + seconds
    while window.shown == shown and time.perf_counter() < end:
        if not window._step():
            return False
    return window.shown > shown
