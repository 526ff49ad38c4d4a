"""What every figure must hold: nothing cut off at its edge, and no legend over its axes."""

from matplotlib.figure import Figure

from vinetrack.figures.style import look


def assert_nothing_is_cut_off(figure: Figure) -> None:
    with look():
        figure.draw_without_rendering()
        drawn, edge = figure.get_tightbbox(), figure.bbox_inches.padded(0.02)
        assert edge.x0 <= drawn.x0 <= drawn.x1 <= edge.x1
        assert edge.y0 <= drawn.y0 <= drawn.y1 <= edge.y1
        for legend in [*figure.legends, *(ax.get_legend() for ax in figure.axes if ax.get_legend())]:
            for ax in figure.axes:
                assert not legend.get_window_extent().padded(-1).overlaps(ax.get_window_extent().padded(-1))
