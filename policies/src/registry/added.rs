//! Policies that are added while the program runs, such as those written in Python.

use std::sync::{OnceLock, PoisonError, RwLock};

use toml::Table;

use super::{PolicyEntry, linked};
use crate::parameters::StepParameter;
use crate::policy::{DensityPolicy, PolicyError, PolicyResult, SceneInfo};

/// Builds the policies of one entry. Implement it for policies that are not Rust types; Rust types implement
/// [`ConfiguredPolicy`](super::ConfiguredPolicy).
pub trait PolicyFactory: Send + Sync {
    /// Names of all parameters, in declaration order.
    fn parameter_names(&self) -> Vec<String>;

    /// The defaults, for a run of 30,000 steps.
    ///
    /// # Errors
    /// When a default cannot be written as TOML.
    fn defaults(&self) -> Result<Table, String>;

    /// Converts parameters to their types.
    ///
    /// # Errors
    /// The reason why a value does not fit.
    fn typed(&self, table: Table) -> Result<Table, String>;

    /// Converts parameters to their types, and [decides](super::ConfiguredPolicy::decided) those that are left to the
    /// scene.
    ///
    /// # Errors
    /// As [`typed`](Self::typed).
    fn decided(&self, table: Table, _scene: &SceneInfo) -> Result<Table, String> {
        self.typed(table)
    }

    /// Builds a policy from the result of [`decided`](Self::decided), which has a value for every parameter.
    ///
    /// # Errors
    /// [`PolicyError::BadParameter`] when a value is out of range; any other error of the policy.
    fn build(&self, table: Table, scene: &SceneInfo) -> PolicyResult<Box<dyn DensityPolicy>>;

    /// What the policy's edits depend on besides this version of densify: the version of an interpreter, the checksum of a file.
    /// `None` for policies that are compiled with densify.
    fn provenance(&self) -> Option<String> {
        None
    }
}

impl PolicyEntry {
    /// The entry of a policy that is to be [added](add). `place` is its file and line, `doc` its manual page.
    pub fn with_factory(
        (name, summary, source): (&'static str, &'static str, &'static str),
        doc: &'static str,
        place: (&'static str, u32),
        step_parameters: &'static [StepParameter],
        factory: &'static dyn PolicyFactory,
    ) -> Self {
        let added_parameters = &[];
        Self { name, summary, source, doc, place, step_parameters, added_parameters, factory }
    }
}

/// An added policy.
struct Added {
    /// Identifies the definition: a later one with the same identity replaces it.
    identity: String,
    entry: &'static PolicyEntry,
}

static ADDED: RwLock<Vec<Added>> = RwLock::new(Vec::new());

/// Adds a policy, in place of one that was added with the same name and `identity` (for example, the module and name of
/// a class), since a notebook may define a class again.
///
/// # Errors
/// [`PolicyError::DuplicateName`] when another policy has this name.
pub fn add(entry: PolicyEntry, identity: &str) -> PolicyResult {
    // The list is whole even if a thread has panicked while it held the lock.
    add_to(&mut ADDED.write().unwrap_or_else(PoisonError::into_inner), entry, identity)
}

fn add_to(all: &mut Vec<Added>, entry: PolicyEntry, identity: &str) -> PolicyResult {
    let known = all.iter_mut().find(|known| known.entry.name == entry.name);
    let other = known.as_ref().filter(|known| known.identity != identity);
    let other = other.map(|known| known.entry);
    if let Some(other) = other.or_else(|| linked().find(|other| other.name == entry.name)) {
        return Err(PolicyError::DuplicateName {
            name: entry.name.to_owned(),
            first: other.location(),
            second: entry.location(),
        });
    }
    // Entries live as long as the program, as those that are linked do.
    let entry: &'static PolicyEntry = Box::leak(Box::new(entry));
    match known {
        Some(known) => known.entry = entry,
        None => all.push(Added { identity: identity.to_owned(), entry }),
    }
    Ok(())
}

/// The added policies.
pub(super) fn all() -> Vec<&'static PolicyEntry> {
    let all = ADDED.read().unwrap_or_else(PoisonError::into_inner);
    all.iter().map(|added| added.entry).collect()
}

/// Imports a file or a module that adds policies.
type Importer = fn(&str) -> PolicyResult;

static IMPORTER: OnceLock<Importer> = OnceLock::new();

/// Sets the function that [`import`] calls. Only the first call has an effect.
pub fn set_importer(importer: Importer) {
    let _ = IMPORTER.set(importer);
}

/// Imports the policies in a Python file (`….py`) or module, unless it has been imported.
///
/// # Errors
/// When this program cannot run Python, or the import fails.
pub fn import(file_or_module: &str) -> PolicyResult {
    match IMPORTER.get() {
        Some(importer) => importer(file_or_module),
        None => Err(PolicyError::Other(format!(
            "{file_or_module}: this program has no Python; policies in Python need the `densify` that `pip install \
             densify-3dgs` brings"
        ))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A policy with one parameter, which cannot be built.
    struct Broken;

    impl PolicyFactory for Broken {
        fn parameter_names(&self) -> Vec<String> {
            vec!["every".to_owned()]
        }
        fn defaults(&self) -> Result<Table, String> {
            Ok(Table::from_iter([("every".to_owned(), 3000.into())]))
        }
        fn typed(&self, table: Table) -> Result<Table, String> {
            Ok(table)
        }
        fn build(&self, _: Table, _: &SceneInfo) -> PolicyResult<Box<dyn DensityPolicy>> {
            Err(PolicyError::Other("it is broken".to_owned()))
        }
    }

    fn entry(name: &'static str, line: u32) -> PolicyEntry {
        let steps = &[StepParameter::Step("every")];
        PolicyEntry::with_factory(
            (name, "fails", "a test"),
            "# Broken",
            ("a.py", line),
            steps,
            &Broken,
        )
    }

    #[test]
    fn the_same_definition_replaces_and_another_is_refused() {
        let mut all = Vec::new();
        add_to(&mut all, entry("broken", 1), "a.Broken").unwrap();
        add_to(&mut all, entry("broken", 7), "a.Broken").unwrap();
        add_to(&mut all, entry("other", 9), "a.Other").unwrap();
        let places: Vec<String> = all.iter().map(|added| added.entry.location()).collect();
        assert_eq!(places, ["a.py:7", "a.py:9"]);
        let error = add_to(&mut all, entry("broken", 2), "b.Broken").unwrap_err().to_string();
        assert!(error.contains("registered twice: a.py:7 and a.py:2"), "{error}");
        let error = add_to(&mut all, entry("diet", 3), "a.Diet").unwrap_err().to_string();
        assert!(
            error.contains("`diet` is registered twice") && error.contains("a.py:3"),
            "{error}"
        );
        assert_eq!(all.len(), 2);
    }

    #[test]
    fn added_policies_have_parameters_that_scale() {
        let scene = crate::event::Event::new(1, 1, 1).scene;
        let scene = SceneInfo { iterations: 300, ..scene };
        let entry = entry("broken", 1);
        assert_eq!(entry.effective(&Table::new(), &scene).unwrap()["every"].as_integer(), Some(30));
        assert_eq!(entry.manual(), "# Broken\n");
        let error = entry.build(&Table::new(), &scene).err().map(|error| error.to_string());
        assert_eq!(error.as_deref(), Some("it is broken"));
    }

    #[test]
    fn a_program_without_python_refuses_its_policies() {
        let error = import("steady.py").unwrap_err().to_string();
        assert!(
            error.contains("steady.py") && error.contains("pip install densify-3dgs"),
            "{error}"
        );
    }
}
