//! Documents of headings, paragraphs, tables, pictures and code, rendered as Markdown or as an HTML page.

use std::fmt;

use maud::{Markup, html};

use super::{Table, Text, page};
use densify_run::failure::Failure;

enum Block {
    Heading(usize, Text),
    Paragraph(Text),
    Table(Table),
    Picture { file: String, caption: String },
    Code { language: &'static str, code: String },
}

/// A document, rendered as Markdown by [`Display`](fmt::Display) and as HTML by [`Document::to_html`].
pub struct Document {
    title: String,
    blocks: Vec<Block>,
}

impl Document {
    /// A document with a title and nothing else.
    pub fn new(title: &str) -> Self {
        Self { title: title.to_owned(), blocks: vec![Block::Heading(1, title.into())] }
    }

    /// Starts a section.
    pub fn section(&mut self, title: &str) {
        self.blocks.push(Block::Heading(2, title.into()));
    }

    /// Starts a subsection.
    pub fn subsection(&mut self, title: &str) {
        self.blocks.push(Block::Heading(3, title.into()));
    }

    /// Adds a paragraph.
    pub fn paragraph(&mut self, text: impl Into<Text>) {
        self.blocks.push(Block::Paragraph(text.into()));
    }

    /// Adds a table.
    pub fn table(&mut self, table: Table) {
        self.blocks.push(Block::Table(table));
    }

    /// Adds a picture from a file.
    pub fn picture(&mut self, file: String, caption: String) {
        self.blocks.push(Block::Picture { file, caption });
    }

    /// Adds lines of code.
    pub fn code(&mut self, language: &'static str, code: String) {
        self.blocks.push(Block::Code { language, code });
    }

    /// The document as an HTML page. `embed` returns the URI of a picture's file.
    ///
    /// # Errors
    /// Errors of `embed`.
    pub fn to_html(
        &self,
        embed: impl Fn(&str) -> Result<String, Failure>,
    ) -> Result<String, Failure> {
        let block = |block: &Block| {
            Ok(match block {
                Block::Heading(1, title) => html! { h1 { (title.to_html()) } },
                Block::Heading(2, title) => html! { h2 { (title.to_html()) } },
                Block::Heading(_, title) => html! { h3 { (title.to_html()) } },
                Block::Paragraph(text) => html! { p { (text.to_html()) } },
                Block::Table(table) => table.to_html(),
                Block::Picture { file, caption } => {
                    let uri = embed(file)?;
                    html! { figure.plot { img src=(uri) alt=(caption); } }
                }
                Block::Code { code, .. } => {
                    html! { pre tabindex="0" { code { (code.trim_end_matches('\n')) } } }
                }
            })
        };
        let blocks = self.blocks.iter().map(block).collect::<Result<Vec<Markup>, Failure>>()?;
        Ok(page(&self.title, &html! { @for block in &blocks { (block) } }))
    }
}

impl fmt::Display for Document {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (at, block) in self.blocks.iter().enumerate() {
            if at > 0 {
                writeln!(f)?;
            }
            match block {
                Block::Heading(level, title) => writeln!(f, "{} {title}", "#".repeat(*level))?,
                Block::Paragraph(text) => writeln!(f, "{text}")?,
                Block::Table(table) => write!(f, "{table}")?,
                Block::Picture { file, caption } => writeln!(f, "![{caption}]({file})")?,
                Block::Code { language, code } => write!(f, "```{language}\n{code}```\n")?,
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Column;

    #[test]
    fn a_document_is_rendered_as_markdown_and_as_html() {
        let mut table = Table::new([Column::text("a"), Column::number("b")]);
        table.row([Text::from("1"), Text::default().plain("x ").bold("2")]);
        table.row(["<x>|", "–"]);
        let mut document = Document::new("A <title>");
        document.paragraph(Text::from("Text with ").code("code <b>").plain(" and ").bold("bold"));
        document.section("Part");
        document.table(table);
        document.subsection("Small");
        document.picture("plot.svg".into(), "a \"plot\"".into());
        document.code("toml", "x = \"<\"\n\ny = 1\n".into());
        assert_eq!(
            document.to_string(),
            "# A <title>\n\nText with `code <b>` and **bold**\n\n## Part\n\n| a | b |\n|---|---|\n\
             | 1 | x **2** |\n| <x>\\| | – |\n\n### Small\n\n![a \"plot\"](plot.svg)\n\n```toml\nx = \"<\"\n\ny = 1\n```\n"
        );
        let page = document.to_html(|file| Ok(format!("data:{file}"))).unwrap();
        for expected in [
            "<title>A &lt;title&gt;</title>",
            "<h1>A &lt;title&gt;</h1>",
            "<p>Text with <code>code &lt;b&gt;</code> and <strong>bold</strong></p>",
            "<h2>Part</h2>",
            "<th scope=\"col\">a</th><th scope=\"col\" class=\"number\">b</th>",
            "<tr><td>1</td><td class=\"number\">x <strong>2</strong></td></tr><tr><td>&lt;x&gt;|</td>",
            "<h3>Small</h3>",
            "<img src=\"data:plot.svg\" alt=\"a &quot;plot&quot;\">",
            "<code>x = &quot;&lt;&quot;\n\ny = 1</code></pre>",
        ] {
            assert!(page.contains(expected), "{expected} is not in {page}");
        }
        let failed = document.to_html(|_| Err(Failure::input("gone"))).unwrap_err();
        assert_eq!(failed.to_string(), "gone");
    }
}
