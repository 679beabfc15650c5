//! A scan as it grows, as a vector: sums that new samples add to, so that a look costs the same at
//! its hundredth second as at its first.

use std::sync::Arc;

use super::joint::{JointEmbedder, Present, SourceEmbedder};
use super::series::{SeriesEmbedder, SeriesSums};
use crate::recognise::error::RecogniseError;
use crate::recognise::features::block_sums::GrowingBlocks;
use crate::recognise::features::frame_features::{PackedFrames, SourceViews};
use crate::recognise::features::image_features::{Part, PixelGrid};
use crate::recognise::features::window_sums::WindowSums;
use crate::recognise::features::windowed_frames::ViewFrames;
use crate::recognise::shape::LibraryShape;
use crate::scene::SourceId;
use crate::trial::Image;

/// The scan so far. Its vector equals that of the trial that its samples make.
pub(super) struct ScanSums {
    shape: Arc<LibraryShape>,
    /// In the order of the vector.
    sources: Vec<Option<SourceSums>>,
}

enum SourceSums {
    Series(Box<SeriesScan>),
    /// Its stretch of the vector.
    Picture(Vec<f32>),
}

struct SeriesScan {
    views: SourceViews,
    /// Samples so far.
    samples: usize,
    sums: SeriesSums,
    blocks: GrowingBlocks,
    /// Samples that are not yet used up, one list a view: all, until its first frame is complete.
    pending: [Vec<f32>; 2],
}

impl ScanSums {
    /// Before the first sample.
    pub fn new(joint: &JointEmbedder, shape: &Arc<LibraryShape>) -> Self {
        let sources = joint.stretches.iter().map(|_| None).collect();
        Self { shape: shape.clone(), sources }
    }

    /// Takes the next samples of a source, interleaved. Sources that the library lacks are passed
    /// over.
    ///
    /// # Errors
    /// If the rate cannot be compared with the library's, or changes during the scan.
    pub fn push(
        &mut self,
        joint: &JointEmbedder,
        id: &SourceId,
        rate_hz: f64,
        samples: &[f32],
    ) -> Result<(), RecogniseError> {
        let Some(place) = joint.stretches.iter().position(|s| s.spec.id == *id) else {
            return Ok(());
        };
        let stretch = &joint.stretches[place];
        let SourceEmbedder::Series(embedder) = &stretch.embedder else { return Ok(()) };
        let slot = &mut self.sources[place];
        if slot.is_none() {
            let views = SourceViews::new(&stretch.spec, (rate_hz, 0), &self.shape);
            *slot = Some(SourceSums::Series(Box::new(SeriesScan::new(views, embedder))));
        }
        let Some(SourceSums::Series(scan)) = slot else { return Ok(()) };
        let own_hz = scan.views.0[0].rate_hz;
        if own_hz != rate_hz || !scan.views.comparable(&embedder.views) {
            return Err(RecogniseError::Rates {
                source_name: id.clone(),
                query_hz: rate_hz,
                library_hz: if own_hz == rate_hz { embedder.views.0[0].rate_hz } else { own_hz },
                trial: "the scan's library".into(),
            });
        }
        scan.push(embedder, samples);
        Ok(())
    }

    /// Takes a picture.
    pub fn push_picture(&mut self, joint: &JointEmbedder, id: &SourceId, picture: &Image) {
        let place = joint.stretches.iter().position(|s| s.spec.id == *id);
        if let Some(place) = place
            && let SourceEmbedder::Picture(embedder) = &joint.stretches[place].embedder
        {
            let mut vectors = embedder.embed(&PixelGrid::new(picture), &[Part::Whole]);
            self.sources[place] = vectors.pop().map(SourceSums::Picture);
        }
    }

    /// As [`JointEmbedder::says_something`], of those sources that `keep` wants.
    pub fn says_something(&self, joint: &JointEmbedder, keep: impl Fn(&SourceId) -> bool) -> bool {
        let mut sources = joint.stretches.iter().zip(&self.sources);
        sources.any(|(stretch, source)| match source {
            Some(SourceSums::Series(scan)) if keep(&stretch.spec.id) => {
                scan.samples >= scan.views.0[1].points
                    && (stretch.level_counts() || !scan.block_sums().is_constant())
            }
            Some(SourceSums::Picture(_)) => keep(&stretch.spec.id),
            _ => false,
        })
    }

    /// The vector so far, in the library's deviations, of those sources that came and that `keep`
    /// wants.
    pub fn vector(
        &self,
        joint: &JointEmbedder,
        keep: impl Fn(&SourceId) -> bool,
    ) -> (Vec<f32>, Present) {
        let mut vector = vec![0.0; joint.dims()];
        let mut present = vec![false; self.sources.len()];
        for (place, (stretch, source)) in joint.stretches.iter().zip(&self.sources).enumerate() {
            let Some(source) = source.as_ref().filter(|_| keep(&stretch.spec.id)) else { continue };
            let of_source = match (source, &stretch.embedder) {
                (SourceSums::Series(scan), SourceEmbedder::Series(embedder)) => {
                    scan.vector(embedder)
                }
                (SourceSums::Picture(of_picture), _) => of_picture.clone(),
                _ => continue,
            };
            vector[stretch.columns.clone()].copy_from_slice(&of_source);
            present[place] = true;
        }
        joint.standardise(&mut vector, &present);
        (vector, present)
    }
}

impl SeriesScan {
    fn new(views: SourceViews, embedder: &SeriesEmbedder) -> Self {
        Self {
            sums: embedder.no_sums(),
            blocks: GrowingBlocks::new(views.0[0].channels, views.block()),
            pending: Default::default(),
            samples: 0,
            views,
        }
    }

    fn push(&mut self, embedder: &SeriesEmbedder, samples: &[f32]) {
        self.samples += samples.len() / self.views.0[0].channels;
        let sums = &mut self.sums;
        self.blocks.extend(samples, |of_block| sums.blocks.add(of_block));
        for (v, view) in self.views.0.iter().enumerate() {
            let pending = &mut self.pending[v];
            pending.extend_from_slice(samples);
            let mut fresh = ViewFrames { view: view.clone(), values: Vec::new() };
            let used = fresh.extend(pending) * view.channels;
            pending.drain(..used);
            if !fresh.values.is_empty() {
                embedder.add_frames(&mut self.sums, v, &rounded(&fresh.values, view.width()));
            }
        }
    }

    /// Block sums, with those of the block that is not complete.
    fn block_sums(&self) -> WindowSums {
        let mut sums = self.sums.blocks.clone();
        let open = self.blocks.open();
        if !open.is_empty() {
            sums.add(&open);
        }
        sums
    }

    fn vector(&self, embedder: &SeriesEmbedder) -> Vec<f32> {
        let mut sums = self.sums.clone();
        for (v, view) in self.views.0.iter().enumerate() {
            if sums.frames(v) == 0 {
                let padded = ViewFrames::new(view.clone(), &self.pending[v]);
                embedder.add_frames(&mut sums, v, &rounded(&padded.values, view.width()));
            }
        }
        sums.blocks = self.block_sums();
        embedder.vector(&sums, &self.blocks.reference(), self.views.0[0].rate_hz)
    }
}

/// Values as a library keeps them.
fn rounded(values: &[f32], width: usize) -> Vec<f32> {
    let (packed, mut out) = (PackedFrames::new(values), Vec::new());
    packed.unpack(width, 0..packed.frames(width), &mut out);
    out
}
