"""Map of the craters that a candidate build lost and gained."""

from reports.figures.canvas import Canvas
from reports.figures.theme import color
from reports.values import ChangedCraters


def draw_changed_craters(canvas: Canvas, craters: ChangedCraters) -> None:
    """Draw tracks of craters by longitude and latitude, coloured by their change, and new false detections."""
    axes = canvas.axes(0.75, 0.55, canvas.width_in - 1.0, canvas.height_in - 0.75)
    for chosen, role, size in (
        (craters.change == 0, "muted", 2.0),
        (craters.change > 0, "blue", 5.0),
        (craters.change < 0, "vermillion", 5.0),
    ):
        x, y = craters.longitude_deg[chosen], craters.latitude_deg[chosen]
        axes.plot(x, y, "o", color=color(role), markersize=size, alpha=0.8)
    x, y = craters.false_longitude_deg, craters.false_latitude_deg
    axes.plot(x, y, "x", color=color("orange"), markersize=4.0)
    axes.grid(True, axis="both")
    axes.set_xlabel("longitude, degrees east")
    axes.set_ylabel("latitude, degrees")
