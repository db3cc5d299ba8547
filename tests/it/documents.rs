//! Checks that documents name only existing files, headings, flags and symbols, stay short, and link only complete
//! studies.

use std::collections::BTreeSet;
use std::path::Path;

/// Folders of the project. Files in the root belong to it too; other folders in the root do not.
const FOLDERS: [&str; 11] = [
    ".cargo", ".ci", ".github", "benches", "docs", "policies", "python", "scenegen", "shaders",
    "src", "tests",
];
/// Generated from the options of a run, so neither counted nor searched.
const GENERATED: &str = "docs/options.md";
/// Documents about the code, in which a name that ends in a slash must be a folder.
const ABOUT_CODE: [&str; 3] = ["ARCHITECTURE.md", "CONTRIBUTING.md", "docs/numerics.md"];
/// A name with one of these extensions must be a file of the project.
const CODE: [&str; 4] = [".rs", ".wgsl", ".py", ".sh"];
/// Files whose words count as existing names.
const WORDS_FROM: [&str; 6] = [".rs", ".wgsl", ".py", ".sh", ".js", ".toml"];
/// This file, which must not count as a source of names: its examples name things that do not exist.
const THIS: &str = "tests/it/documents.rs";
/// Parts that mark a name as a placeholder.
const PLACEHOLDERS: [&str; 4] = ["NAME", "FORMAT", "*", "…"];
/// Names that are allowed even though no source file contains them.
const EXEMPT: [&str; 10] = [
    // Notation for transforms.
    "a_from_b",
    "camera_from_world",
    // Created by the recipe for a new policy.
    "tests/conformance.rs",
    // Composed by the program.
    "images_4",
    "images_8",
    "ours_ITERATION",
    // Variables of the Vulkan loader.
    "VK_DRIVER_FILES",
    // Names of gsplat.
    "sample_add",
    "inject_noise",
    "cap_max",
];
/// Word limits of all documents together and of single ones.
const MOST_WORDS: usize = 16_000;
const MOST_WORDS_OF: [(&str, usize); 2] = [("README.md", 1_300), ("ARCHITECTURE.md", 1_800)];

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn read(path: &str) -> String {
    std::fs::read_to_string(root().join(path)).unwrap_or_else(|e| panic!("{path}: {e}"))
}

/// The entries of a folder, each with true if it is a folder itself.
fn entries(folder: &str) -> Vec<(String, bool)> {
    let entries = std::fs::read_dir(root().join(folder));
    let entries = entries.unwrap_or_else(|e| panic!("{folder}: {e}"));
    let named = entries.map(|entry| {
        let entry = entry.expect("an entry of a folder");
        (entry.file_name().to_string_lossy().into_owned(), entry.path().is_dir())
    });
    named.collect()
}

/// The files of the project and the names in its source.
#[derive(Default)]
struct Tree {
    /// Paths from the root, with `/`.
    files: BTreeSet<String>,
    folders: BTreeSet<String>,
    /// The words of each source file without comments.
    words: Vec<BTreeSet<String>>,
    /// Words of any source file that begin with `--`.
    flags: BTreeSet<String>,
}

impl Tree {
    fn of_project() -> Self {
        let mut tree = Self::default();
        let in_root = entries("").into_iter().filter(|(_, is_folder)| !is_folder);
        tree.files.extend(in_root.map(|(name, _)| name));
        for folder in FOLDERS {
            tree.add(folder);
        }
        for path in &tree.files {
            if path == THIS || !has_ending(path, &WORDS_FROM) {
                continue;
            }
            let text = read(path);
            let is_code = |line: &&str| !line.trim_start().starts_with("//");
            let code: String = text.lines().filter(is_code).flat_map(|line| [line, "\n"]).collect();
            tree.words.push(code.split(|c: char| !is_in_name(c)).map(str::to_owned).collect());
            let flags = code.split(is_not_in_flag).filter(|word| word.starts_with("--"));
            tree.flags.extend(flags.map(str::to_owned));
        }
        tree
    }

    fn add(&mut self, folder: &str) {
        self.folders.insert(folder.to_owned());
        for (name, is_folder) in entries(folder) {
            let path = format!("{folder}/{name}");
            if !is_folder {
                self.files.insert(path);
            } else if name != "target" && !name.starts_with('.') {
                self.add(&path);
            }
        }
    }

    /// All hand-written documents with their text.
    fn documents(&self) -> Vec<(&str, String)> {
        let written = self.files.iter().filter(|path| path.ends_with(".md") && *path != GENERATED);
        written.map(|path| (path.as_str(), read(path))).collect()
    }

    /// True if one source file has all of these words.
    fn knows(&self, names: &[&str]) -> bool {
        self.words.iter().any(|words| names.iter().all(|&name| words.contains(name)))
    }

    /// True if everything that a code span names exists.
    fn has(&self, document: &str, span: &str) -> bool {
        let mut flags =
            span.split(is_not_in_flag).filter(|word| word.len() > 2 && word.starts_with("--"));
        let is_flag = |flag: &str| {
            // Flags are declared as fields: `--sh-degree` is `sh_degree`.
            let field = flag.trim_start_matches('-').replace('-', "_");
            self.flags.contains(flag) || self.knows(&[field.as_str()])
        };
        flags.all(is_flag) && (is_excused(span) || self.has_name(document, span))
    }

    fn has_name(&self, document: &str, span: &str) -> bool {
        if has_ending(span, &CODE) && !span.contains(' ') {
            return self.files.iter().any(|path| is_tail(span, path));
        }
        let folder = span.strip_suffix('/').filter(|_| ABOUT_CODE.contains(&document));
        if let Some(folder) = folder {
            return self.folders.iter().any(|path| is_tail(folder, path));
        }
        let names: Vec<&str> = span.trim_end_matches("()").split("::").collect();
        let are_names = names.iter().all(|name| !name.is_empty() && name.chars().all(is_in_name));
        let is_symbol = names.len() > 1 || span.contains('_') || is_camel_case(span);
        !are_names || !is_symbol || self.knows(&names)
    }

    /// True if a path from the root exists.
    fn has_path(&self, path: &str) -> bool {
        self.files.contains(path) || self.folders.contains(path)
    }

    /// True if the target of a link exists: a file, and its heading if the link names one.
    fn has_target(&self, document: &str, target: &str) -> bool {
        let (file, anchor) = target.split_once('#').unwrap_or((target, ""));
        let file = linked(document, file);
        self.has_path(&file)
            && (anchor.is_empty() || headings(&read(&file)).any(|heading| heading == anchor))
    }
}

fn words(text: &str) -> usize {
    text.split_whitespace().count()
}

fn is_in_name(c: char) -> bool {
    c.is_ascii_alphanumeric() || c == '_'
}

fn is_not_in_flag(c: char) -> bool {
    !(c.is_ascii_alphanumeric() || c == '-')
}

fn is_camel_case(name: &str) -> bool {
    name.starts_with(|c: char| c.is_ascii_uppercase())
        && name.contains(|c: char| c.is_ascii_lowercase())
}

fn has_ending(path: &str, endings: &[&str]) -> bool {
    endings.iter().any(|ending| path.ends_with(ending))
}

/// True if a path is `tail`, or ends with it.
fn is_tail(tail: &str, path: &str) -> bool {
    path.strip_suffix(tail).is_some_and(|rest| rest.is_empty() || rest.ends_with('/'))
}

fn is_excused(name: &str) -> bool {
    EXEMPT.contains(&name) || PLACEHOLDERS.iter().any(|part| name.contains(part))
}

/// The path from the root that a link in a document leads to.
fn linked(document: &str, file: &str) -> String {
    if file.is_empty() {
        return document.to_owned();
    }
    let mut parts: Vec<&str> = document.split('/').collect();
    parts.pop();
    for part in file.split('/') {
        match part {
            "." => {}
            ".." => {
                parts.pop();
            }
            name => parts.push(name),
        }
    }
    parts.join("/")
}

/// The lines of a document outside of fenced blocks.
fn prose(text: &str) -> impl Iterator<Item = &str> {
    let mut is_fenced = false;
    text.lines().filter(move |line| {
        let is_fence = line.trim_start().starts_with("```");
        is_fenced ^= is_fence;
        !is_fence && !is_fenced
    })
}

/// The anchors of all headings.
fn headings(text: &str) -> impl Iterator<Item = String> {
    let headings = prose(text).filter(|line| line.starts_with('#'));
    headings.map(|line| {
        let words = line.trim_start_matches('#').trim().to_lowercase();
        let kept = words.chars().filter(|c| c.is_alphanumeric() || "-_ ".contains(*c));
        kept.map(|c| if c == ' ' { '-' } else { c }).collect()
    })
}

/// The texts between backticks.
fn code_spans(text: &str) -> impl Iterator<Item = &str> {
    prose(text).flat_map(|line| line.split('`').skip(1).step_by(2))
}

/// Targets of links within the project.
fn links(text: &str) -> impl Iterator<Item = &str> {
    let targets = prose(text).flat_map(|line| line.split("](").skip(1));
    let targets = targets.filter_map(|rest| rest.split(')').next());
    targets.filter(|target| !target.contains("://"))
}

/// Words that begin with a folder of the project, including those in code blocks.
fn paths(text: &str) -> impl Iterator<Item = &str> {
    let ends_word = |c: char| c.is_whitespace() || "`()[]{}<>,;:#\"'|*".contains(c);
    let is_path = |word: &&str| {
        let mut rests = FOLDERS.iter().filter_map(|folder| word.strip_prefix(folder));
        rests.any(|rest| rest.starts_with('/'))
    };
    text.split(ends_word).map(|word| word.trim_end_matches(['.', '/'])).filter(is_path)
}

/// All names in a document that do not exist.
fn missing(tree: &Tree, document: &str, text: &str) -> Vec<String> {
    let paths = paths(text).filter(|path| !is_excused(path) && !tree.has_path(path));
    let spans = code_spans(text).filter(|span| !tree.has(document, span));
    let links = links(text).filter(|target| !tree.has_target(document, target));
    paths.chain(spans).chain(links).map(|name| format!("{document}: {name}")).collect()
}

#[test]
fn names_in_documents_exist() {
    let tree = Tree::of_project();
    let documents = tree.documents();
    assert!(documents.iter().any(|(path, _)| *path == "docs/data.md"), "docs/data.md is missing");
    let missing: Vec<String> =
        documents.iter().flat_map(|(path, text)| missing(&tree, path, text)).collect();
    assert!(missing.is_empty(), "these do not exist: {missing:#?}");
}

#[test]
fn missing_names_are_detected() {
    let tree = Tree::of_project();
    let has = |text: &str| missing(&tree, "docs/data.md", text).is_empty();
    for existing in [
        "`Path` and `Path::new` in `invariants.rs` and `tests/it/main.rs`",
        "[errors](errors.md#during-training), [readme](../README.md)",
        "`--fail-below`, `--budget auto`, `1/255`, `NAME.rs`, `a b`",
        "    tests/tours/policy.sh",
    ] {
        assert!(has(existing), "{existing}");
    }
    for absent in [
        "`no_such_function_anywhere`",
        "`NoSuchTypeAnywhere`",
        "`Path::no_such_function_anywhere`",
        "`no_such_file.rs`",
        "`--no-such-flag-anywhere 3`",
        "[data](data.md#no-such-heading)",
        "[data](no_such_file.md)",
        "    tests/tours/no_such_file.sh",
    ] {
        assert!(!has(absent), "{absent}");
    }
}

/// A study is a table below its question, its conclusion and its command. At least one document must link it.
#[test]
fn studies_are_complete_and_linked() {
    let tree = Tree::of_project();
    let mut linked_to = BTreeSet::new();
    for (document, text) in tree.documents() {
        linked_to.extend(links(&text).map(|target| linked(document, target)));
    }
    let studies = || tree.files.iter().filter(|path| path.starts_with("docs/studies/"));
    assert!(studies().count() > 0);
    for path in studies() {
        assert!(linked_to.contains(path), "no document links {path}");
        if !path.ends_with(".tsv") {
            continue;
        }
        let text = read(path);
        let (head, rows): (Vec<&str>, Vec<&str>) =
            text.lines().partition(|line| line.starts_with("# "));
        for key in ["# question: ", "# conclusion: ", "# command"] {
            assert!(head.iter().any(|line| line.starts_with(key)), "{path} has no line {key:?}");
        }
        let columns = |row: &&str| row.split('\t').count();
        let first = rows.first().map(columns);
        assert!(
            rows.len() > 1 && rows.iter().all(|row| Some(columns(row)) == first),
            "{path}: {rows:#?}"
        );
    }
}

/// Readers have limited time: adding to a document at its limit means cutting elsewhere.
#[test]
fn documents_stay_short() {
    for (path, most) in MOST_WORDS_OF {
        let count = words(&read(path));
        assert!(count <= most, "{path} has {count} words, more than {most}");
    }
    let tree = Tree::of_project();
    let counts: Vec<(&str, usize)> =
        tree.documents().iter().map(|(path, text)| (*path, words(text))).collect();
    let count: usize = counts.iter().map(|(_, count)| count).sum();
    assert!(
        count <= MOST_WORDS,
        "the documents have {count} words, more than {MOST_WORDS}: {counts:#?}"
    );
}
