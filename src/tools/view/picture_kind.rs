//! The kinds of pictures that the page shows.

use serde::{Deserialize, Serialize};

/// The content of a picture. From `Rows` on, Gaussians have colours other than their own.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum PictureKind {
    /// The model, as `densify render` draws it.
    Render,
    /// The photograph of the view.
    Photograph,
    /// The visible difference between render and photograph, by FLIP.
    Difference,
    /// The distance along the optical axis.
    Depth,
    /// The opacity of the model.
    Opacity,
    /// Number of Gaussians blended into each pixel.
    Count,
    /// Every Gaussian in a distinct colour.
    Rows,
    /// Gaussians coloured by opacity.
    RowOpacity,
    /// Gaussians coloured by their longest axis.
    RowSize,
    /// Gaussians coloured by elongation.
    RowShape,
    /// Gaussians coloured by the mean gradient of their projected centre.
    RowGradient,
    /// Gaussians coloured by their largest blend weight.
    RowWeight,
    /// Gaussians coloured by the share of their weight in front of the surface.
    RowInFront,
    /// Gaussians coloured by the steps since their creation.
    RowAge,
    /// Gaussians coloured by the steps since their last edit.
    RowEdit,
}

/// The name and explanation of a kind on the page.
#[derive(Debug, Clone, Copy, Serialize)]
pub(super) struct Legend {
    pub(super) kind: PictureKind,
    pub(super) label: &'static str,
    /// One sentence on what the picture shows.
    about: &'static str,
    needs_photograph: bool,
    /// The unit of the numbers that the colours represent, if they do.
    unit: Option<&'static str>,
}

impl PictureKind {
    pub(super) const ALL: [Self; 15] = [
        Self::Render,
        Self::Photograph,
        Self::Difference,
        Self::Depth,
        Self::Opacity,
        Self::Count,
        Self::Rows,
        Self::RowOpacity,
        Self::RowSize,
        Self::RowShape,
        Self::RowGradient,
        Self::RowWeight,
        Self::RowInFront,
        Self::RowAge,
        Self::RowEdit,
    ];

    /// True if the picture exists only at the camera of a photograph.
    pub(super) fn needs_photograph(self) -> bool {
        matches!(self, Self::Photograph | Self::Difference)
    }

    /// True if Gaussians are rendered in colours other than their own.
    pub(super) fn colours_rows(self) -> bool {
        self >= Self::Rows
    }

    /// True if the training views of a finished model are needed to measure the number that the picture shows.
    pub(super) fn is_measured(self) -> bool {
        matches!(self, Self::RowGradient | Self::RowWeight | Self::RowInFront)
    }

    pub(super) fn legend(self) -> Legend {
        let (label, about, unit) = match self {
            Self::Render => (
                "Render",
                "The model, rendered exactly as by densify render and densify eval.",
                None,
            ),
            Self::Photograph => (
                "Photograph",
                "The photograph from this camera, at the resolution used for training.",
                None,
            ),
            Self::Difference => (
                "Difference (FLIP)",
                "How visible the difference between render and photograph is.",
                Some("FLIP"),
            ),
            Self::Depth => (
                "Depth",
                "The mean distance along the optical axis, in the dataset's own units.",
                Some("units"),
            ),
            Self::Opacity => {
                ("Opacity", "How much of the background the model covers.", Some("opacity"))
            }
            Self::Count => (
                "Gaussians per pixel",
                "How many Gaussians are blended into a pixel, which determines the cost of a picture.",
                Some("Gaussians"),
            ),
            Self::Rows => ("Separate Gaussians", "Every Gaussian in a distinct colour.", None),
            Self::RowOpacity => {
                ("Opacity of Gaussians", "Every Gaussian coloured by its opacity.", Some("opacity"))
            }
            Self::RowSize => (
                "Size of Gaussians",
                "Every Gaussian coloured by its longest standard deviation, on a logarithmic scale.",
                Some("units"),
            ),
            Self::RowShape => (
                "Shape of Gaussians",
                "Every Gaussian coloured by the ratio of its longest to its middle axis, on a logarithmic scale; \
                needles are bright.",
                Some("to 1"),
            ),
            Self::RowGradient => (
                "Gradient of Gaussians",
                "Every Gaussian coloured by the mean loss gradient of its projected centre, on a logarithmic \
                scale. Policies split or clone Gaussians whose gradient is large.",
                Some("per view"),
            ),
            Self::RowWeight => (
                "Largest weight of Gaussians",
                "Every Gaussian coloured by its largest weight in any pixel of the training views; dark ones are \
                hardly visible anywhere.",
                Some("weight"),
            ),
            Self::RowInFront => (
                "Weight in front of the surface",
                "Every Gaussian coloured by the share of its weight that is in front of the surface, the model's own \
                median depth, in the training views; floaters are bright, and densify clean removes them.",
                Some("share"),
            ),
            Self::RowAge => (
                "Age of Gaussians",
                "Every Gaussian coloured by the steps since its creation; a lower bound if training was resumed \
                since.",
                Some("steps"),
            ),
            Self::RowEdit => (
                "Last edit of Gaussians",
                "Every Gaussian coloured by the steps since the policy created or modified it, as far as known if \
                training was resumed.",
                Some("steps"),
            ),
        };
        Legend { kind: self, label, about, needs_photograph: self.needs_photograph(), unit }
    }
}
