//! What the boxes of levels follow, and how.

use super::{Levels, Scene};
use crate::levels::link_of;
use crate::{Error, Result, Vec3};
use schemars::JsonSchema;
use serde::de::value::MapAccessDeserializer;
use serde::de::{MapAccess, Visitor};
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use std::fmt;
use std::ops::RangeInclusive;

/// Cells from a box's middle to its side: fewer leave no room between two levels, more than one level can be.
const HALVES: RangeInclusive<u32> = 8..=512;

/// A tool, a body or a robot that the boxes of levels follow: its name, or a table with what is asked of its boxes besides.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LevelAgent {
    /// Name of a tool, a body, a link of a robot (`"dog/FL_calf"`) or a robot, which stands for its base.
    pub name: String,
    /// As `levels.half`, for this agent's boxes; absent: that.
    pub half: Option<u32>,
    /// Added to where the followed part is, along the world's axes [m].
    pub offset: Vec3,
    /// The part that is followed.
    pub at: AgentPart,
}

/// Which part of an agent boxes follow.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "String", into = "String")]
pub enum AgentPart {
    /// `"origin"`: all of it, by the middle of its bounds.
    #[default]
    Origin,
    /// `"lowest"`: the bottom of its bounds, of a robot those of all its links.
    Lowest,
    /// The name of a link of a robot.
    Link(String),
}

const ORIGIN: &str = "origin";
const LOWEST: &str = "lowest";

impl From<String> for AgentPart {
    fn from(word: String) -> Self {
        match word.as_str() {
            ORIGIN => Self::Origin,
            LOWEST => Self::Lowest,
            _ => Self::Link(word),
        }
    }
}

impl From<AgentPart> for String {
    fn from(part: AgentPart) -> Self {
        part.to_string()
    }
}

impl fmt::Display for AgentPart {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Origin => ORIGIN,
            Self::Lowest => LOWEST,
            Self::Link(link) => link,
        })
    }
}

impl From<&str> for LevelAgent {
    fn from(name: &str) -> Self {
        Self { name: name.to_owned(), ..Self::default() }
    }
}

impl LevelAgent {
    /// Whether its boxes hold all of a body that a coupling calls so, wherever it goes: nothing coarser than the finest
    /// level comes near it then.
    pub fn surrounds(&self, body: &str) -> bool {
        self.offset == [0.0; 3]
            && match &self.at {
                AgentPart::Origin => self.name == body,
                AgentPart::Lowest => false,
                AgentPart::Link(link) => link_of(&self.name, body) == Some(link),
            }
    }
}

/// As it is written if there is more to say than a name.
#[derive(Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
#[schemars(rename = "LevelAgentTable")]
struct Table {
    /// Name of a tool, a body, a link of a robot (`"dog/FL_calf"`) or a robot, which stands for its base.
    name: String,
    /// Cells of a level from the middle of this agent's box to each of its sides, in place of `levels.half`. Even, from 8 to 512.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    half: Option<u32>,
    /// Added to where the followed part is, along the world's axes [m]. No longer than the world. What the offset leaves outside the box meets
    /// coarser ground.
    #[serde(default, skip_serializing_if = "is_zero")]
    offset: Vec3,
    /// What the box follows. `"origin"`: all of the agent, by the middle of its bounds. `"lowest"`: the bottom of its bounds, which the box
    /// always holds, and what is higher may meet coarser ground; of a robot, the bottom of the bounds of all its links. Or the name of a
    /// link of the robot, all of it.
    #[serde(default, skip_serializing_if = "is_origin")]
    #[schemars(with = "String")]
    at: AgentPart,
}

fn is_zero(offset: &Vec3) -> bool {
    *offset == [0.0; 3]
}

fn is_origin(at: &AgentPart) -> bool {
    *at == AgentPart::Origin
}

impl Serialize for LevelAgent {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let Self { name, half, offset, at } = self.clone();
        if half.is_none() && is_zero(&offset) && is_origin(&at) {
            return name.serialize(serializer);
        }
        Table { name, half, offset, at }.serialize(serializer)
    }
}

impl<'de> Deserialize<'de> for LevelAgent {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct NameOrTable;
        impl<'de> Visitor<'de> for NameOrTable {
            type Value = LevelAgent;
            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("a name, or a table with one")
            }
            fn visit_str<E: serde::de::Error>(self, name: &str) -> Result<LevelAgent, E> {
                Ok(name.into())
            }
            fn visit_map<A: MapAccess<'de>>(self, map: A) -> Result<LevelAgent, A::Error> {
                let Table { name, half, offset, at } = Table::deserialize(MapAccessDeserializer::new(map))?;
                Ok(LevelAgent { name, half, offset, at })
            }
        }
        deserializer.deserialize_any(NameOrTable)
    }
}

impl JsonSchema for LevelAgent {
    fn schema_name() -> std::borrow::Cow<'static, str> {
        "LevelAgent".into()
    }
    fn json_schema(generator: &mut schemars::SchemaGenerator) -> schemars::Schema {
        schemars::json_schema!({
            "description": "A tool, a body or a robot that boxes follow: its name, or a table.",
            "anyOf": [{ "type": "string" }, generator.subschema_for::<Table>()]
        })
    }
}

impl Levels {
    /// Whether boxes hold all of a body that a coupling calls so, wherever it goes; `None` if the scene leaves it to couplings what is followed.
    pub fn surround(&self, body: &str) -> Option<bool> {
        self.agents.as_ref().map(|agents| agents.iter().any(|agent| agent.surrounds(body)))
    }
}

impl Scene {
    pub(super) fn check_half(&self, path: &str, half: u32) -> Result<()> {
        self.require(
            HALVES.contains(&half) && half.is_multiple_of(2),
            path,
            format!("is {half}"),
            format!("must be even and from {} to {}", HALVES.start(), HALVES.end()),
        )
    }

    pub(super) fn check_agents(&self) -> Result<()> {
        let far = (0..3).map(|d| self.world.max[d] - self.world.min[d]).fold(0.0, f64::max);
        for (i, agent) in self.levels.agents.iter().flatten().enumerate() {
            let path = format!("levels.agents[{i}]");
            agent.half.map_or(Ok(()), |half| self.check_half(&format!("{path}.half"), half))?;
            self.require(
                agent.offset.iter().all(|by| by.abs() <= far),
                &format!("{path}.offset"),
                format!("is {:?}", agent.offset),
                format!("give less than the world is wide, {far} m, along each axis"),
            )?;
            let names = |of: &str| of == agent.name;
            self.require(
                !(self.tool.iter().any(|tool| names(&tool.name)) && self.body.iter().any(|body| names(&body.name))),
                &path,
                format!("is '{}', as a tool and a body are both called", agent.name),
                "give one of them another name",
            )?;
            let known = || self.tool.iter().map(|t| &t.name).chain(self.body.iter().map(|b| &b.name));
            // What else couplings move, links of robots first, is known once they are made.
            if self.robot.is_empty() && self.coupling.is_empty() && !known().any(|k| *k == agent.name) {
                return Err(Error::Unknown {
                    path: self.place(&path),
                    kind: "tool or body of this scene",
                    name: agent.name.clone(),
                    known: known().filter(|k| !k.is_empty()).cloned().collect(),
                });
            }
        }
        Ok(())
    }
}
