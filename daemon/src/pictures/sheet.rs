//! A grid of pictures, each with a caption.

use ab_glyph::{Font, FontRef, PxScale, ScaleFont, point};
use image::{Rgb, RgbImage};

/// A picture with the line that stands above it.
pub struct Tile {
    /// What the picture shows.
    pub caption: String,
    /// The picture, sRGB encoded.
    pub picture: RgbImage,
}

/// Rows of tiles under a title, with a footer that tells how to read them.
pub struct Sheet {
    /// Heading of the sheet.
    pub title: String,
    /// Rows from top to bottom; tiles from left to right.
    pub rows: Vec<Vec<Tile>>,
    /// Lines under the last row.
    pub footer: Vec<String>,
}

const MARGIN: u32 = 12;
const TITLE_PX: f32 = 24.0;
const CAPTION_PX: f32 = 17.0;
const PAPER: Rgb<u8> = Rgb([250, 250, 248]);
const INK: Rgb<u8> = Rgb([24, 24, 28]);

impl Sheet {
    /// Draws the sheet; tiles keep their own size.
    pub fn draw(&self) -> RgbImage {
        let font = font();
        let caption_height = CAPTION_PX as u32 + 8;
        let row_height =
            |row: &Vec<Tile>| row.iter().map(|tile| tile.picture.height()).max().unwrap_or(0) + caption_height + MARGIN;
        let row_width = |row: &Vec<Tile>| row.iter().map(|tile| tile_width(&font, tile) + MARGIN).sum::<u32>() + MARGIN;
        let text_width = |text: &str, px: f32| text_width(&font, text, px) + 2 * MARGIN;
        let width = (self.rows.iter().map(row_width))
            .chain(self.footer.iter().map(|line| text_width(line, CAPTION_PX)))
            .chain([text_width(&self.title, TITLE_PX)])
            .max()
            .unwrap_or(1);
        let title_height = TITLE_PX as u32 + 2 * MARGIN;
        let height = title_height
            + self.rows.iter().map(row_height).sum::<u32>()
            + self.footer.len() as u32 * caption_height
            + MARGIN;
        let mut page = RgbImage::from_pixel(width, height, PAPER);
        write_text(&mut page, &font, MARGIN, MARGIN, TITLE_PX, &self.title);
        let mut y = title_height;
        for row in &self.rows {
            let mut x = MARGIN;
            for tile in row {
                write_text(&mut page, &font, x, y, CAPTION_PX, &tile.caption);
                image::imageops::replace(&mut page, &tile.picture, i64::from(x), i64::from(y + caption_height));
                x += tile_width(&font, tile) + MARGIN;
            }
            y += row_height(row);
        }
        for line in &self.footer {
            write_text(&mut page, &font, MARGIN, y, CAPTION_PX, line);
            y += caption_height;
        }
        page
    }
}

fn tile_width(font: &FontRef<'_>, tile: &Tile) -> u32 {
    tile.picture.width().max(text_width(font, &tile.caption, CAPTION_PX))
}

fn font() -> FontRef<'static> {
    FontRef::try_from_slice(epaint_default_fonts::UBUNTU_LIGHT).expect("the bundled font is well formed")
}

fn text_width(font: &FontRef<'_>, text: &str, px: f32) -> u32 {
    let scaled = font.as_scaled(PxScale::from(px));
    text.chars().map(|c| scaled.h_advance(scaled.glyph_id(c))).sum::<f32>().ceil() as u32
}

fn write_text(page: &mut RgbImage, font: &FontRef<'_>, x: u32, y: u32, px: f32, text: &str) {
    let scaled = font.as_scaled(PxScale::from(px));
    let mut pen_x = x as f32;
    let baseline = y as f32 + scaled.ascent();
    for c in text.chars() {
        let id = scaled.glyph_id(c);
        let glyph = id.with_scale_and_position(PxScale::from(px), point(pen_x, baseline));
        pen_x += scaled.h_advance(id);
        let Some(outline) = font.outline_glyph(glyph) else { continue };
        let bounds = outline.px_bounds();
        outline.draw(|gx, gy, coverage| {
            let (px_x, px_y) = (bounds.min.x as i64 + i64::from(gx), bounds.min.y as i64 + i64::from(gy));
            let inside = px_x >= 0 && px_y >= 0 && px_x < i64::from(page.width()) && px_y < i64::from(page.height());
            if inside {
                let pixel = page.get_pixel_mut(px_x as u32, px_y as u32);
                let cover = (coverage * 1.35).min(1.0);
                for (channel, ink) in pixel.0.iter_mut().zip(INK.0) {
                    *channel = (f32::from(*channel) * (1.0 - cover) + f32::from(ink) * cover).round() as u8;
                }
            }
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tiles_are_copied_unchanged_and_text_leaves_ink() {
        let picture = RgbImage::from_fn(40, 30, |x, y| Rgb([x as u8, y as u8, 200]));
        let sheet = Sheet {
            title: "Title".into(),
            rows: vec![vec![Tile { caption: "a caption wider than its picture".into(), picture: picture.clone() }]],
            footer: vec!["how to read this".into()],
        };
        let page = sheet.draw();
        let top = TITLE_PX as u32 + 2 * MARGIN + CAPTION_PX as u32 + 8;
        let crop = image::imageops::crop_imm(&page, MARGIN, top, 40, 30).to_image();
        assert_eq!(crop, picture);
        let dark_above = page.enumerate_pixels().filter(|(_, y, p)| *y < top && p.0[0] < 100).count();
        assert!(dark_above > 50, "title and caption are drawn");
    }
}
