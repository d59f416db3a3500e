//! Plots and tables as text, for a terminal.

use std::fmt::Write as _;
use std::io::{self, IsTerminal, Write};

use ratatui::buffer::Buffer;
use ratatui::layout::Rect;
use ratatui::style::{Color, Style};
use ratatui::symbols::Marker;
use ratatui::text::{Line, Span};
use ratatui::widgets::{Axis, Chart, Dataset, GraphType, Widget};

/// One set of points in a [`plot`].
pub(crate) struct Series<'a> {
    pub name: &'a str,
    /// Its colour; where there are no colours, a plot with one series still says all.
    pub colour: Color,
    /// (x, y); points outside the plot are not drawn.
    pub points: &'a [(f64, f64)],
}

/// The axes of a [`plot`].
pub(crate) struct Axes<'a> {
    /// What x is, with its unit.
    pub x_name: &'a str,
    /// First and last x.
    pub x: [f64; 2],
    /// What y is, with its unit.
    pub y_name: &'a str,
    /// Lowest and highest y.
    pub y: [f64; 2],
}

/// Columns and rows of a plot.
#[derive(Clone, Copy, Debug)]
pub(crate) struct TextSize {
    /// Columns, in characters of the terminal.
    pub width: u16,
    /// Rows, in lines of the terminal.
    pub height: u16,
}

/// The size of plots, on a terminal that is as wide.
const PLOT_SIZE: TextSize = TextSize { width: 100, height: 18 };

impl TextSize {
    /// A plot's size on this terminal.
    pub(crate) fn of_plot() -> Self {
        Self { width: PLOT_SIZE.width.min(window().width).max(40), ..PLOT_SIZE }
    }

    /// The same where `rows` rows of text stand below it, none of which should be lost.
    pub(crate) fn of_plot_above(rows: usize) -> Self {
        let left = usize::from(window().height).saturating_sub(rows + 2).max(6);
        Self { height: PLOT_SIZE.height.min(left as u16), ..Self::of_plot() }
    }
}

/// The terminal that standard output is, or as much as a plot and its text like to have.
fn window() -> TextSize {
    let size = rustix::termios::tcgetwinsize(io::stdout()).ok().filter(|size| size.ws_col > 0 && size.ws_row > 0);
    size.map_or(TextSize { width: PLOT_SIZE.width, height: 60 }, |size| TextSize {
        width: size.ws_col,
        height: size.ws_row,
    })
}

/// Points as braille dots, with axes and a legend; `colours` adds ANSI colours.
pub(crate) fn plot(series: &[Series<'_>], axes: &Axes<'_>, size: TextSize, colours: bool) -> String {
    let area = Rect::new(0, 0, size.width, size.height);
    let mut buffer = Buffer::empty(area);
    let datasets = series.iter().map(|series| {
        Dataset::default()
            .marker(Marker::Braille)
            .graph_type(GraphType::Scatter)
            .style(Style::default().fg(series.colour))
            .data(series.points)
    });
    let axis = |[least, most]: [f64; 2]| {
        let labels = [least, 0.5 * (least + most), most].map(|value| Line::from(format!("{value:.1}")));
        Axis::default().bounds([least, most]).labels(labels)
    };
    // The legend stands in the axis' title: a box of its own would hide what is under it.
    let legend = series.iter().map(|series| Span::styled(format!("  • {}", series.name), series.colour));
    let title: Line<'_> = std::iter::once(Span::raw(axes.y_name)).chain(legend).collect();
    Chart::new(datasets.collect())
        .legend_position(None)
        .x_axis(axis(axes.x).title(axes.x_name))
        .y_axis(axis(axes.y).title(title))
        .render(area, &mut buffer);
    text_of(&buffer, colours)
}

fn text_of(buffer: &Buffer, colours: bool) -> String {
    let mut text = String::new();
    for row in buffer.content.chunks(usize::from(buffer.area.width)) {
        let mut line = String::new();
        let mut now = Color::Reset;
        for cell in row {
            if colours && cell.fg != now {
                now = cell.fg;
                write!(line, "\x1b[{}m", ansi(now)).expect("a String takes all");
            }
            line.push_str(cell.symbol());
        }
        if now != Color::Reset {
            line.push_str("\x1b[39m");
        }
        text.push_str(line.trim_end());
        text.push('\n');
    }
    text
}

/// The foreground's code (ECMA-48, SGR 30 to 39).
const fn ansi(colour: Color) -> u8 {
    match colour {
        Color::Red => 31,
        Color::Green => 32,
        Color::Yellow => 33,
        Color::Blue => 34,
        Color::Magenta => 35,
        Color::Cyan => 36,
        _ => 39,
    }
}

/// Text that is shown again and again in the same place of a terminal; nothing where standard output is none.
#[derive(Debug, Default)]
pub(crate) struct LiveText {
    /// Rows of the terminal that the text took.
    rows: usize,
}

impl LiveText {
    /// Whether anybody would see it.
    pub(crate) fn visible() -> bool {
        io::stdout().is_terminal()
    }

    /// Puts `text` in the place of what was shown before.
    pub(crate) fn show(&mut self, text: &str) {
        if !Self::visible() {
            return;
        }
        let back = if self.rows == 0 { String::new() } else { format!("\x1b[{}F\x1b[J", self.rows) };
        let TextSize { width, height } = window();
        let rows_of = |line: &str| visible(line).div_ceil(usize::from(width)).max(1);
        // Rows that have left the screen at its top cannot be written anew: only the last ones are shown.
        let mut rows = 0;
        let mut shown: Vec<_> = text.trim_end().lines().rev().collect();
        shown.retain(|line| {
            rows += rows_of(line);
            rows < usize::from(height)
        });
        shown.reverse();
        self.rows = shown.iter().map(|line| rows_of(line)).sum();
        // A terminal that has gone away is no failure of what it showed.
        let _ = writeln!(io::stdout().lock(), "{back}{}", shown.join("\n"));
    }
}

/// Characters of a line that take a column: all but those of the colours.
fn visible(line: &str) -> usize {
    let mut inside = false;
    line.chars()
        .filter(|&c| {
            let hidden = inside || c == '\x1b';
            inside = hidden && c != 'm';
            !hidden
        })
        .count()
}

#[cfg(test)]
mod tests {
    use super::*;

    const AXES: Axes<'_> = Axes { x_name: "time / s", x: [0.0, 10.0], y_name: "pupil / mm", y: [0.0, 8.0] };

    fn drawn(points: &[(f64, f64)], colours: bool) -> String {
        let size = TextSize { width: 40, height: 12 };
        plot(&[Series { name: "raw", colour: Color::Red, points }], &AXES, size, colours)
    }

    fn dots(text: &str) -> usize {
        text.chars().filter(|c| ('\u{2801}'..='\u{28ff}').contains(c)).count()
    }

    #[test]
    fn points_and_axes_are_drawn() {
        let text = drawn(&[(0.0, 1.0), (5.0, 4.0), (10.0, 7.0)], false);
        assert_eq!(text.lines().count(), 12);
        assert!(text.contains("pupil / mm  • raw") && text.contains("8.0") && text.contains("10.0"), "{text}");
        assert_eq!(dots(&text), 3, "{text}");
        assert_eq!(dots(&drawn(&[(5.0, 9.0)], false)), 0, "a point outside is not drawn");
        assert!(!text.contains('\x1b'));
    }

    #[test]
    fn colours_take_no_column() {
        assert_eq!(visible("\x1b[31m⠡\x1b[39m m"), 3);
        assert_eq!(visible(""), 0);
    }

    #[test]
    fn colours_are_switched_off_at_the_end_of_each_line() {
        let text = drawn(&[(5.0, 4.0)], true);
        let coloured: Vec<_> = text.lines().filter(|line| line.contains("\x1b[31m")).collect();
        assert!(!coloured.is_empty());
        assert!(coloured.iter().all(|line| line.matches("\x1b[39m").count() >= 1), "{text:?}");
    }
}
