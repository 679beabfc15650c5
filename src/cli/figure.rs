//! Writes figures as SVG or PDF, and their numbers as JSON beside them, so that figures can be drawn
//! again.

use std::path::{Path, PathBuf};

use serde::Serialize;

use super::choose::SplitArgs;
use super::condition::WhereArgs;
use super::{Done, Failure, Named, SourceArgs, one_of};
use crate::draw::Look;

/// The data of a figure, and the file to write.
#[derive(clap::Args)]
pub(super) struct FigureArgs {
    /// Picture to write, as SVG or, named .pdf, as PDF; the JSON and any other pictures are written
    /// beside it
    #[arg(long, value_name = "FILE")]
    pub out: PathBuf,
    #[command(flatten)]
    pub look: LookArgs,
    #[command(flatten)]
    pub split: SplitArgs,
    #[command(flatten)]
    pub sources: SourceArgs,
    #[command(flatten)]
    pub only: WhereArgs,
    /// Print the JSON on stdout, too
    #[arg(long)]
    pub json: bool,
}

#[derive(Clone, Copy, clap::Args)]
pub(super) struct LookArgs {
    /// Printed width of the figure: that of a journal's column or page (default: for screens)
    #[arg(long = "width", value_name = "WIDTH", value_parser = one_of(WIDTHS))]
    width_mm: Option<u32>,
    /// Draw no title; synthetic data are marked all the same
    #[arg(long)]
    no_title: bool,
}

const WIDTHS: [Named<u32>; 2] = [(85, "85mm", ""), (180, "180mm", "")];

impl From<LookArgs> for Look {
    fn from(LookArgs { width_mm, no_title }: LookArgs) -> Self {
        Self { width_mm, no_title }
    }
}

impl FigureArgs {
    /// Writes the picture and, beside it, its numbers as JSON. Returns the paths of both.
    pub(super) fn keep(&self, svg: &str, numbers: &impl Serialize) -> Done<Vec<PathBuf>> {
        let beside = self.out.with_extension("json");
        draw(&self.out, svg)?;
        write(&beside, serde_json::to_string_pretty(numbers)? + "\n")?;
        Ok(vec![self.out.clone(), beside])
    }
}

/// Whether a path is the JSON file of an earlier run, not a recording.
pub(super) fn is_earlier(path: &Path) -> bool {
    path.extension().is_some_and(|e| e == "json") && path.is_file()
}

pub(super) fn draw(path: &Path, svg: &str) -> Done {
    if is_pdf(path) { write(path, pdf(path, svg)?) } else { write(path, svg) }
}

/// Refuses, before the work, a picture that [`draw`] cannot write.
pub(super) fn can_draw(path: &Path) -> Done {
    if !ends(path, &["svg", "pdf"]) {
        let problem = "name the picture .svg or .pdf; other files are written beside it";
        return Err(Failure::usage_at(path, problem));
    }
    if is_pdf(path) && cfg!(not(feature = "pdf")) {
        let problem = "this program was built without PDF (`--features pdf`); name it .svg";
        return Err(Failure::usage_at(path, problem));
    }
    can_write(path, &["svg", "pdf"])
}

/// Refuses, before the work, a file in no folder, and one that is there already and has none of the endings
/// that such an output has: it may be a recording.
pub(super) fn can_write(path: &Path, endings: &[&str]) -> Done {
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
    let problem = match folder.filter(|folder| !folder.is_dir()) {
        Some(folder) => format!("there is no folder {}; make it first", folder.display()),
        None if path.is_dir() => "this is a folder; name a file in it".into(),
        None if path.is_file() && !ends(path, endings) => format!(
            "another file has this name; it is kept, since it does not end in .{}",
            endings.join(" or .")
        ),
        None => return Ok(()),
    };
    Err(Failure::usage_at(path, problem))
}

fn ends(path: &Path, endings: &[&str]) -> bool {
    let extension = path.extension().unwrap_or_default();
    endings.iter().any(|ending| extension.eq_ignore_ascii_case(ending))
}

fn is_pdf(path: &Path) -> bool {
    ends(path, &["pdf"])
}

/// The PDF of an SVG, with the glyphs that it uses of a sans-serif font of this machine.
#[cfg(feature = "pdf")]
fn pdf(path: &Path, svg: &str) -> Done<Vec<u8>> {
    use svg2pdf::usvg;

    /// Fonts that hold the signs of the figures, the likeliest first.
    const FONTS: [&str; 6] =
        ["Arial", "Helvetica", "DejaVu Sans", "Liberation Sans", "Noto Sans", "Segoe UI"];
    let mut options = usvg::Options::default();
    let fonts = options.fontdb_mut();
    fonts.load_system_fonts();
    let is_here = |name: &&str| {
        fonts.faces().any(|face| face.families.iter().any(|(family, _)| family == name))
    };
    let Some(font) = FONTS.into_iter().find(is_here) else {
        let problem = "a PDF embeds its font, and this machine has none of Arial, Helvetica, DejaVu \
                       Sans, Liberation Sans, Noto Sans and Segoe UI; install one (Debian: \
                       fonts-dejavu-core), or name the picture .svg";
        return Err(Failure::at(path, problem));
    };
    fonts.set_sans_serif_family(font);
    let tree = usvg::Tree::from_str(svg, &options).map_err(|error| Failure::at(path, error))?;
    // Millimetres of an SVG are of 96 pixels an inch.
    let page = svg2pdf::PageOptions { dpi: 96.0 };
    svg2pdf::to_pdf(&tree, svg2pdf::ConversionOptions::default(), page)
        .map_err(|error| Failure::at(path, error))
}

#[cfg(not(feature = "pdf"))]
fn pdf(path: &Path, _: &str) -> Done<Vec<u8>> {
    can_draw(path).map(|()| Vec::new())
}

pub(super) fn write(path: &Path, bytes: impl AsRef<[u8]>) -> Done {
    std::fs::write(path, bytes).map_err(|error| Failure::at(path, error))
}
