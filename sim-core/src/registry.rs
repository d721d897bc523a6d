//! Where plugins meet: by kind and name.

use crate::parameter::{self, Giver, Parameter, Parameters, Table};
use crate::solid::Solid;
use crate::{Backend, Coupling, Error, Material, Observer, Result, Scene, Task, loader};
use barchan_abi as abi;
use std::collections::BTreeMap;
use std::fmt;
use std::path::Path;
use std::sync::Arc;

/// Makes a coupling.
pub type CouplingMaker = Arc<dyn Fn(&CouplingSetup<'_>) -> Result<Box<dyn Coupling>> + Send + Sync>;
/// Makes a task.
pub type TaskMaker = Arc<dyn Fn(&TaskSetup<'_>) -> Result<Box<dyn Task>> + Send + Sync>;
/// Makes an observer for runs of a scene; `None` if it has nothing to see there.
pub type ObserverMaker = Arc<dyn Fn(&Scene) -> Result<Option<Box<dyn Observer>>> + Send + Sync>;
/// Reads a triangle mesh as a solid: file, factor to metres.
pub type MeshReader = Arc<dyn Fn(&Path, f64) -> Result<Box<dyn Solid>> + Send + Sync>;

/// What a coupling is made from.
#[derive(Debug)]
pub struct CouplingSetup<'a> {
    /// The scene.
    pub scene: &'a Scene,
    /// Name of this coupling, by which errors, trace and ledger tell it from others of its kind: [`Coupling::name`] must return it.
    pub name: &'a str,
    /// What its entry in the scene says, and defaults.
    pub parameters: &'a Parameters,
    /// Key path of its parameters.
    pub(crate) path: String,
}

impl CouplingSetup<'_> {
    /// An error about one of the parameters, such as `rate` or `zone[0].rate`, with the file and line where it stands.
    pub fn fault(&self, key: &str, what: impl Into<String>, mend: impl Into<String>) -> Error {
        self.scene.fault(&format!("{}.{key}", self.path), what, mend)
    }
}

/// What a task is made from.
#[derive(Debug)]
pub struct TaskSetup<'a> {
    /// The scene that it is to be played in; `None`: the task's own.
    pub scene: Option<&'a Scene>,
    /// What the scene's `[task]` says, and defaults.
    pub parameters: &'a Parameters,
    /// Name as registered.
    pub name: &'a str,
}

impl TaskSetup<'_> {
    /// An error about one of the parameters, with the file and line where it stands.
    pub fn fault(&self, key: &str, what: impl Into<String>, mend: impl Into<String>) -> Error {
        match self.scene {
            Some(scene) => scene.fault(&format!("{TASK}.{key}"), what, mend),
            None => Error::Body { path: format!("task '{}': {key}", self.name), what: what.into(), mend: mend.into() },
        }
    }
    /// An error about the scene, which lacks something that the task needs.
    pub fn unfit(&self, what: impl Into<String>, mend: impl Into<String>) -> Error {
        match self.scene {
            Some(scene) => scene.fault("task", what, mend),
            None => Error::Body { path: format!("task '{}'", self.name), what: what.into(), mend: mend.into() },
        }
    }
}

/// Key path of a task's parameters.
const TASK: &str = "task.parameters";

/// A kind of coupling.
#[derive(Clone)]
pub struct CouplingKind {
    /// One sentence.
    pub doc: String,
    /// What an entry of the scene may set: scenes are held to it.
    pub parameters: Vec<Parameter>,
    maker: CouplingMaker,
}

impl CouplingKind {
    /// Makes one.
    ///
    /// # Errors
    /// If the scene cannot be used.
    pub fn make(&self, setup: &CouplingSetup<'_>) -> Result<Box<dyn Coupling>> {
        (self.maker)(setup)
    }
}

/// A kind of task.
#[derive(Clone)]
pub struct TaskKind {
    /// One sentence.
    pub doc: String,
    /// What a scene's `[task]` may set: scenes are held to it.
    pub parameters: Vec<Parameter>,
    maker: TaskMaker,
}

/// All plugins known to a program.
#[derive(Clone, Default)]
pub struct Registry {
    materials: BTreeMap<String, Material>,
    couplings: BTreeMap<String, CouplingKind>,
    backends: BTreeMap<String, Arc<dyn Backend>>,
    tasks: BTreeMap<String, TaskKind>,
    observers: BTreeMap<String, (String, ObserverMaker)>,
    mesh_reader: Option<MeshReader>,
    warnings: Vec<String>,
}

impl fmt::Debug for Registry {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Registry")
            .field("materials", &self.materials.keys())
            .field("couplings", &self.couplings.keys())
            .field("backends", &self.backends.keys())
            .field("tasks", &self.tasks.keys())
            .field("observers", &self.observers.keys())
            .finish_non_exhaustive()
    }
}

impl Registry {
    /// A registry that knows nothing yet.
    pub fn new() -> Self {
        Self::default()
    }

    /// Registers a material by its ABI table, as a loaded library's would be; `origin` is "built-in" or a crate's name.
    /// The pointers in the table must be what the ABI says they are.
    ///
    /// # Errors
    /// [`Error::Plugin`] if the table breaks a rule of the ABI, [`Error::Duplicate`] if the name is taken.
    pub fn add_material(&mut self, table: &'static abi::BarchanMaterial, origin: &str) -> Result<()> {
        // SAFETY: a reference is valid for the whole struct, and the table's own pointers are the caller's promise.
        let material = unsafe { Material::read(table, origin) }?;
        self.insert_materials(vec![material])
    }

    /// Registers a kind of coupling that scenes call for by `name`, with the parameters that their entries may set. Each entry makes one of its own.
    ///
    /// # Errors
    /// [`Error::Duplicate`] if the name is taken, [`Error::Plugin`] if a parameter breaks a rule.
    pub fn add_coupling(
        &mut self,
        name: &str,
        doc: &str,
        parameters: Vec<Parameter>,
        maker: CouplingMaker,
    ) -> Result<()> {
        declared("coupling", name, &parameters)?;
        insert(&mut self.couplings, "coupling", name, CouplingKind { doc: doc.to_owned(), parameters, maker })
    }

    /// Registers a backend under its own name.
    ///
    /// # Errors
    /// [`Error::Duplicate`] if the name is taken, [`Error::Plugin`] if a parameter breaks a rule.
    pub fn add_backend(&mut self, backend: Arc<dyn Backend>) -> Result<()> {
        let name = backend.name().to_owned();
        declared("backend", &name, &backend.parameters())?;
        insert(&mut self.backends, "backend", &name, backend)
    }

    /// Registers a task, with the parameters that a scene's `[task]` may set.
    ///
    /// # Errors
    /// [`Error::Duplicate`] if the name is taken, [`Error::Plugin`] if a parameter breaks a rule.
    pub fn add_task(&mut self, name: &str, doc: &str, parameters: Vec<Parameter>, maker: TaskMaker) -> Result<()> {
        declared("task", name, &parameters)?;
        insert(&mut self.tasks, "task", name, TaskKind { doc: doc.to_owned(), parameters, maker })
    }

    /// Registers an observer, which the command line then makes for every run.
    ///
    /// # Errors
    /// [`Error::Duplicate`] if the name is taken.
    pub fn add_observer(&mut self, name: &str, doc: &str, maker: ObserverMaker) -> Result<()> {
        insert(&mut self.observers, "observer", name, (doc.to_owned(), maker))
    }

    /// Sets what reads triangle meshes for soft bodies; the last one set counts.
    pub fn set_mesh_reader(&mut self, reader: MeshReader) {
        self.mesh_reader = Some(reader);
    }

    /// Loads a library of materials and returns their names. Either all of its materials are registered or none.
    /// The library is never unloaded. Loading is running its code: only load what the user names.
    ///
    /// # Errors
    /// [`Error::Plugin`] saying what is wrong with the library, [`Error::Duplicate`] if a name is taken.
    pub fn load(&mut self, library: &Path) -> Result<Vec<String>> {
        let loaded = loader::load(library)?;
        let names = loaded.materials.iter().map(|m| m.name.clone()).collect();
        self.insert_materials(loaded.materials)?;
        self.warnings.extend(loaded.warning);
        Ok(names)
    }

    fn insert_materials(&mut self, materials: Vec<Material>) -> Result<()> {
        let mut all = self.materials.clone();
        for material in materials {
            if let Some(first) = all.get(&material.name) {
                return Err(Error::Duplicate {
                    kind: "material",
                    name: material.name,
                    first: first.origin.clone(),
                    second: material.origin,
                });
            }
            all.insert(material.name.clone(), material);
        }
        self.materials = all;
        Ok(())
    }

    /// The material law of that name.
    ///
    /// # Errors
    /// [`Error::Unknown`] listing the known ones.
    pub fn material(&self, name: &str) -> Result<&Material> {
        find(&self.materials, "material", name)
    }
    /// The kind of couplings of that name.
    ///
    /// # Errors
    /// [`Error::Unknown`] listing the known ones.
    pub fn coupling(&self, name: &str) -> Result<&CouplingKind> {
        find(&self.couplings, "coupling", name)
    }
    /// The backend of that name.
    ///
    /// # Errors
    /// [`Error::Unknown`] listing the known ones.
    pub fn backend(&self, name: &str) -> Result<&Arc<dyn Backend>> {
        find(&self.backends, "backend", name)
    }
    /// A fresh task of that name in its own scene, with these parameters and defaults; [`task_of`](Self::task_of) makes the one that a scene calls for.
    ///
    /// # Errors
    /// [`Error::Unknown`] listing the known ones; parameters that it has not declared or that it needs; the task's own.
    pub fn task(&self, name: &str, given: &Table) -> Result<Box<dyn Task>> {
        let kind = find(&self.tasks, "task", name)?;
        let fault =
            |path: &str, what: String, mend: String| Error::Body { path: format!("task '{name}': {path}"), what, mend };
        let giver = Giver { whose: format!("task '{name}'"), folder: Path::new(""), fault: &fault };
        let parameters = giver.resolve(&kind.parameters, given, "")?;
        (kind.maker)(&TaskSetup { scene: None, parameters: &parameters, name })
    }
    /// A fresh task as the scene's `[task]` asks for it, to be played in that scene.
    ///
    /// # Errors
    /// [`Error::Unknown`] listing the known ones; parameters that it has not declared, with the scene's line and key; the task's own. A scene without a
    /// `[task]` is one, too.
    pub fn task_of(&self, scene: &Scene) -> Result<Box<dyn Task>> {
        match self.make_task(scene)? {
            Some((task, _)) => Ok(task),
            None => Err(scene.fault("task", "the scene has none", "add a [task] with the name of one")),
        }
    }
    /// The task that a scene asks for, if it asks for one, and its parameters.
    pub(crate) fn make_task(&self, scene: &Scene) -> Result<Option<(Box<dyn Task>, Parameters)>> {
        let Some(spec) = &scene.task else { return Ok(None) };
        let name = spec.name.as_str();
        let kind = find(&self.tasks, "task", name).map_err(|e| e.at(&scene.place("task.name")))?;
        let parameters = scene.resolve(format!("task '{name}'"), &kind.parameters, &spec.parameters, TASK)?;
        let task = (kind.maker)(&TaskSetup { scene: Some(scene), parameters: &parameters, name })?;
        Ok(Some((task, parameters)))
    }
    /// The observers of runs of a scene, in the order of their names.
    ///
    /// # Errors
    /// If one cannot be made.
    pub fn make_observers(&self, scene: &Scene) -> Result<Vec<Box<dyn Observer>>> {
        self.observers.values().filter_map(|(_, maker)| maker(scene).transpose()).collect()
    }
    /// What reads triangle meshes, if anything does.
    pub fn mesh_reader(&self) -> Option<&MeshReader> {
        self.mesh_reader.as_ref()
    }

    /// All materials by name.
    pub fn materials(&self) -> impl Iterator<Item = &Material> {
        self.materials.values()
    }
    /// Names and kinds of all couplings.
    pub fn couplings(&self) -> impl Iterator<Item = (&str, &CouplingKind)> {
        self.couplings.iter().map(|(name, kind)| (name.as_str(), kind))
    }
    /// All backends by name.
    pub fn backends(&self) -> impl Iterator<Item = &dyn Backend> {
        self.backends.values().map(|b| &**b)
    }
    /// Names and kinds of all tasks.
    pub fn tasks(&self) -> impl Iterator<Item = (&str, &TaskKind)> {
        self.tasks.iter().map(|(name, kind)| (name.as_str(), kind))
    }
    /// Names and documentation of all observers.
    pub fn observers(&self) -> impl Iterator<Item = (&str, &str)> {
        self.observers.iter().map(|(name, (doc, _))| (name.as_str(), doc.as_str()))
    }
    /// What the user should know about the libraries loaded.
    pub fn warnings(&self) -> &[String] {
        &self.warnings
    }
}

/// Holds what a crate's plugin declares to the rules.
fn declared(kind: &str, name: &str, parameters: &[Parameter]) -> Result<()> {
    parameter::check(parameters).map_err(|refusal| refusal.of(Path::new(&format!("{kind} '{name}'"))))
}

fn insert<T>(all: &mut BTreeMap<String, T>, kind: &'static str, name: &str, value: T) -> Result<()> {
    if all.contains_key(name) {
        let crate_of = || format!("a crate's register() for {kind}s");
        return Err(Error::Duplicate { kind, name: name.to_owned(), first: crate_of(), second: crate_of() });
    }
    all.insert(name.to_owned(), value);
    Ok(())
}

fn find<'a, T>(all: &'a BTreeMap<String, T>, kind: &'static str, name: &str) -> Result<&'a T> {
    all.get(name).ok_or_else(|| Error::Unknown {
        path: "registry".to_owned(),
        kind,
        name: name.to_owned(),
        known: all.keys().cloned().collect(),
    })
}
