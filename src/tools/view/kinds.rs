//! The kinds of pictures that there are.

use serde::{Deserialize, Serialize};

/// What a picture shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum Kind {
    /// The model, as `densify render` draws it.
    Render,
    /// The photograph that was taken there.
    Photograph,
    /// The visible difference between the two, by FLIP.
    Difference,
    /// The distance along the optical axis.
    Depth,
    /// How opaque the model is.
    Opacity,
    /// How many rows are blended into each pixel.
    Count,
    /// Every row in a colour of its own.
    Rows,
    /// Rows coloured by their opacity.
    RowOpacity,
    /// Rows coloured by their longest axis.
    RowSize,
    /// Rows coloured by how long they are for their width.
    RowShape,
    /// Rows coloured by how strongly the photographs pull at their place.
    RowGradient,
    /// Rows coloured by their largest blend weight.
    RowWeight,
    /// Rows coloured by the steps since they were made.
    RowAge,
    /// Rows coloured by the steps since they were edited.
    RowEdit,
}

/// How a kind is called and explained on the page.
#[derive(Debug, Clone, Copy, Serialize)]
pub(super) struct Legend {
    pub(super) kind: Kind,
    pub(super) label: &'static str,
    /// What is seen, in a sentence.
    about: &'static str,
    needs_photograph: bool,
    /// What the colours stand for, where they stand for numbers.
    unit: Option<&'static str>,
}

impl Kind {
    pub(super) const ALL: [Self; 14] = [
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
        Self::RowAge,
        Self::RowEdit,
    ];

    /// Whether it is there only where a photograph was taken.
    pub(super) fn needs_photograph(self) -> bool {
        matches!(self, Self::Photograph | Self::Difference)
    }

    /// Whether rows are in other colours than their own.
    pub(super) fn paints(self) -> bool {
        matches!(
            self,
            Self::Rows
                | Self::RowOpacity
                | Self::RowSize
                | Self::RowShape
                | Self::RowGradient
                | Self::RowWeight
                | Self::RowAge
                | Self::RowEdit
        )
    }

    pub(super) fn legend(self) -> Legend {
        let (label, about, unit) = match self {
            Self::Render => {
                ("Render", "The model, drawn as densify render and densify eval draw it.", None)
            }
            Self::Photograph => {
                ("Photograph", "What the camera saw there, at the size that was trained on.", None)
            }
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
                ("Opacity", "How much of what lies behind the model it hides.", Some("opacity"))
            }
            Self::Count => (
                "Gaussians per pixel",
                "How many Gaussians are blended into a pixel: what a picture costs.",
                Some("Gaussians"),
            ),
            Self::Rows => ("Gaussians told apart", "Every Gaussian in a colour of its own.", None),
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
                "Every Gaussian coloured by its longest axis over its middle one, on a logarithmic scale: \
                 needles are bright.",
                Some("to 1"),
            ),
            Self::RowGradient => (
                "Gradient of Gaussians",
                "Every Gaussian coloured by how strongly the photographs pull at its place: the mean gradient of \
                 its projected centre, on a logarithmic scale. Policies split or clone where it is large.",
                Some("per view"),
            ),
            Self::RowWeight => (
                "Largest weight of Gaussians",
                "Every Gaussian coloured by the largest weight that it has in any pixel of the training views: \
                 what is dark hardly shows anywhere.",
                Some("weight"),
            ),
            Self::RowAge => (
                "Age of Gaussians",
                "Every Gaussian coloured by the steps since it was made; if training was resumed meanwhile, at \
                 least that many.",
                Some("steps"),
            ),
            Self::RowEdit => (
                "Last edit of Gaussians",
                "Every Gaussian coloured by the steps since the policy made or rewrote it, as far as is \
                 known if training was resumed.",
                Some("steps"),
            ),
        };
        Legend { kind: self, label, about, needs_photograph: self.needs_photograph(), unit }
    }
}
