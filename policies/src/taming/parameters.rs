//! The parameters of `taming`, explained in its manual page.

use serde::{Deserialize, Serialize};

/// Parameters of [`Taming`](super::Taming).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
#[expect(missing_docs, reason = "the manual page documents every parameter, and a test checks it")]
pub struct TamingParams {
    pub grow_from: u32,
    pub grow_until: u32,
    pub grow_every: u32,
    pub multiplier: f64,
    pub tau: f64,
    pub small: f64,
    pub split_factor: f64,
    pub views: u32,
    pub error_weight: f64,
    pub edge_weight: f64,
    pub gradient_weight: f64,
    pub opacity_weight: f64,
    pub depth_weight: f64,
    pub radius_weight: f64,
    pub scale_weight: f64,
    pub distance_weight: f64,
    pub map_weight: f64,
    pub count_weight: f64,
    pub blend_weight: f64,
    pub min_opacity: f64,
    pub max_scale: f64,
    pub max_scale_from: u32,
    pub prune: PruneDraw,
    pub prune_share: f64,
    pub prune_until: u32,
    pub reset_every: u32,
    pub reset_opacity: f64,
    pub white_reset_at: u32,
    pub sh_every: u32,
    pub sh_rest: f64,
}

/// The rows that the prune draws from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum PruneDraw {
    /// Dead rows, by their own scores.
    Candidates,
    /// All rows, as in the published code, which misaligns the scores: after splits, a row is drawn by the score of
    /// another row. Of the rows drawn, only dead ones are pruned.
    Published,
}

impl Default for TamingParams {
    fn default() -> Self {
        Self {
            grow_from: 500,
            grow_until: 15_000,
            grow_every: 500,
            multiplier: 0.0,
            tau: 2e-4,
            small: 0.01,
            split_factor: 1.6,
            views: 10,
            error_weight: 50.0,
            edge_weight: 50.0,
            gradient_weight: 25.0,
            opacity_weight: 100.0,
            depth_weight: 5.0,
            radius_weight: 10.0,
            scale_weight: 25.0,
            distance_weight: 50.0,
            map_weight: 10.0,
            count_weight: 0.1,
            blend_weight: 50.0,
            min_opacity: 0.005,
            max_scale: 0.1,
            max_scale_from: 3000,
            prune: PruneDraw::Candidates,
            prune_share: 0.5,
            prune_until: 14_500,
            reset_every: 3000,
            reset_opacity: 0.01,
            white_reset_at: 500,
            sh_every: 16,
            sh_rest: 2.5e-4,
        }
    }
}

impl TamingParams {
    /// All weights, by name.
    pub(super) fn weights(&self) -> [(&'static str, f64); 11] {
        [
            ("error_weight", self.error_weight),
            ("edge_weight", self.edge_weight),
            ("gradient_weight", self.gradient_weight),
            ("opacity_weight", self.opacity_weight),
            ("depth_weight", self.depth_weight),
            ("radius_weight", self.radius_weight),
            ("scale_weight", self.scale_weight),
            ("distance_weight", self.distance_weight),
            ("map_weight", self.map_weight),
            ("count_weight", self.count_weight),
            ("blend_weight", self.blend_weight),
        ]
    }
}
