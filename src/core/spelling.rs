//! The spelling of options in messages. Errors store only the names of options; the code that shows a message
//! decides how they are written for its reader.

use std::fmt::Display;

/// How options are written in messages.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Spelling {
    /// Flags of a command: `--tile-cap 90000`.
    #[default]
    Terminal,
    /// Keyword arguments of a function: `tile_cap=90000`.
    Keyword,
}

impl Spelling {
    /// An option without its value.
    pub fn option(self, name: &str) -> String {
        match (self, name) {
            (Self::Terminal, "scene") => "SCENE".to_owned(),
            (Self::Terminal, _) => format!("--{}", name.replace('_', "-")),
            (Self::Keyword, _) => format!("{name}="),
        }
    }

    /// An option without a value, switched on.
    pub fn switch(self, name: &str) -> String {
        match self {
            Self::Terminal => self.option(name),
            Self::Keyword => format!("{name}=True"),
        }
    }

    /// An option with a number.
    pub fn set(self, name: &str, value: impl Display) -> String {
        match self {
            Self::Terminal => format!("{} {value}", self.option(name)),
            Self::Keyword => format!("{name}={value}"),
        }
    }

    /// An option with a text, such as a word, a size with its unit, or a file.
    pub fn text(self, name: &str, value: impl Display) -> String {
        match self {
            Self::Terminal => self.set(name, value),
            Self::Keyword => format!("{name}=\"{value}\""),
        }
    }

    /// One `member=value` pair of an option that takes several.
    pub fn member(self, name: &str, member: &str, value: impl Display) -> String {
        match self {
            Self::Terminal => format!("{} {member}={value}", self.option(name)),
            Self::Keyword => format!("{name}={{\"{member}\": \"{value}\"}}"),
        }
    }
}
