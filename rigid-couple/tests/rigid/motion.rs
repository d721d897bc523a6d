//! Paths of driven tools.

use crate::{batch, refusal, rigid, step, within};
use barchan_core::scene::{Interpolation, Keyframe};
use barchan_core::{Command, Coupling, NodeBatch};
use barchan_rigid::motion::{KeyframePath, Pose};
use glam::{DQuat, DVec3};

fn frames() -> Vec<Keyframe> {
    let turn = |angle: f64| {
        let q = DQuat::from_rotation_z(angle);
        Some([q.w, q.x, q.y, q.z])
    };
    vec![
        Keyframe { time: 0.1, position: [0.0, 0.0, 0.0], rotation: turn(0.0) },
        Keyframe { time: 0.2, position: [0.1, 0.0, 0.3], rotation: turn(1.0) },
        Keyframe { time: 0.5, position: [0.2, 0.1, 0.1], rotation: turn(2.5) },
        Keyframe { time: 0.6, position: [0.5, 0.1, 0.1], rotation: turn(2.0) },
    ]
}

fn path(interpolation: Interpolation) -> KeyframePath {
    KeyframePath::new(&frames(), interpolation, DQuat::IDENTITY).unwrap()
}

#[test]
fn keyframes_are_met_and_not_overshot() {
    // A pen that overshoots its keyframes writes beyond the letter: exact at the keyframes, within them between.
    for interpolation in [Interpolation::Smooth, Interpolation::Linear] {
        let path = path(interpolation);
        for frame in frames() {
            assert_eq!(path.pose(frame.time).position.to_array(), frame.position);
            let [w, x, y, z] = frame.rotation.unwrap();
            assert!(path.pose(frame.time).rotation.angle_between(DQuat::from_xyzw(x, y, z, w)) < 1e-15);
        }
        assert_eq!(path.pose(-1.0), path.pose(0.1));
        assert_eq!(path.pose(9.0), path.pose(0.6));
        for i in 0..=1000 {
            let time = 0.1 + 0.5 * f64::from(i) / 1000.0;
            let k = frames().iter().rposition(|f| f.time <= time).unwrap().min(2);
            let (a, b) = (DVec3::from_array(frames()[k].position), DVec3::from_array(frames()[k + 1].position));
            let x = path.pose(time).position;
            assert!((x.cmpge(a.min(b) - 1e-15) & x.cmple(a.max(b) + 1e-15)).all(), "{time}: {x}");
        }
    }
}

#[test]
fn smooth_paths_have_no_velocity_jump() {
    // A jump of the tool's velocity is an infinite acceleration of the sand it touches: C¹ in position and angle, at rest at
    // both ends, turning points at rest.
    let path = path(Interpolation::Smooth);
    let d = 1e-6;
    let twist = |from: f64, to: f64| path.pose(from).chord(&path.pose(to), to - from);
    let (mut jump, mut fastest) = (0f64, 0f64);
    for frame in frames() {
        let (before, after) = (twist(frame.time - d, frame.time), twist(frame.time, frame.time + d));
        jump = jump.max((after.linear - before.linear).length()).max((after.angular - before.angular).length());
        fastest = fastest.max(after.linear.length());
    }
    within("jump of velocity at keyframes [m/s, rad/s]", jump, 1e-3);
    assert!(fastest > 0.1, "the path goes through its keyframes, not from halt to halt");
    assert!(twist(0.2, 0.2 + d).linear.z.abs() < 1e-3, "z turns back there");
    assert!(twist(0.2, 0.2 + d).angular.z > 1.0, "the turn goes on");
    assert!(twist(0.5, 0.5 + d).angular.z.abs() < 1e-2, "the turn turns back");
}

#[test]
fn poses_after_steps_are_those_of_the_path() {
    // Integrated velocities drift off the path; chords do not, whatever the step.
    let tools = "[[tool]]
        name = 'pen'
        shape = { sphere = { radius = 0.1 } }
        motion = { keyframes = { frames = [{ time = 0.0, position = [0, 0, 0] }, { time = 0.3, position = [0.3, 0.1, 0], rotation = [0.5, 0.5, 0.5, 0.5] }, { time = 1.0, position = [0, 0, 0] }] } }";
    let mut rigid = rigid(tools);
    let frames = vec![
        Keyframe { time: 0.0, position: [0.0; 3], rotation: None },
        Keyframe { time: 0.3, position: [0.3, 0.1, 0.0], rotation: Some([0.5; 4]) },
        Keyframe { time: 1.0, position: [0.0; 3], rotation: None },
    ];
    let path = KeyframePath::new(&frames, Interpolation::Smooth, DQuat::IDENTITY).unwrap();
    let mut time = 0.0;
    for i in 0..400 {
        let dt = 1e-3 * (1.0 + 2.0 * f64::from(i % 3));
        let before = rigid.bodies()[0].clone();
        step(&mut rigid, time, dt, &mut NodeBatch::default());
        let after = &rigid.bodies()[0];
        assert_eq!(after.position, path.pose(time + dt).position.to_array());
        let carried = DVec3::from_array(before.position) + dt * DVec3::from_array(after.velocity);
        assert!((carried - DVec3::from_array(after.position)).length() < 1e-15);
        time += dt;
    }
    let last = rigid.bodies()[0].clone();
    assert_eq!(
        (last.position, last.velocity, last.angular_velocity),
        ([0.0; 3], [0.0; 3], [0.0; 3]),
        "at rest after the last keyframe"
    );
}

#[test]
fn top_speed_counts_the_tip() {
    // B50: a blade of 0.5 m that turns at 10 rad/s has its tip at 5 m/s, which bounds the time step though its origin rests.
    let rigid = rigid(
        "[[tool]]\nname = 'blade'\nshape = { box = { min = [0, -0.01, -0.01], max = [0.5, 0.01, 0.01] } }\nmotion = { velocity = { angular = [0, 0, 10] } }",
    );
    let speed = rigid.max_speed(0.0, 1e-3);
    within("tip speed against 5 m/s", (speed / 5.0 - 1.0).abs(), 1e-3);
    assert!(speed >= 5.0);
}

#[test]
fn agents_drive_tools_by_velocity() {
    // B51: an action moves the tool by exactly v dt and turns it by ω dt; NaN, unknown and undriven tools are errors that name it.
    let mut rigid = rigid(
        "[[tool]]\nname = 'hand'\nshape = { sphere = { radius = 0.1 } }\nmotion = { velocity = {} }\n[[tool]]\nname = 'wall'\nshape = { plane = { normal = [0, 0, 1] } }",
    );
    rigid.act("hand", &Command::Twist { linear: [1.0, 0.0, -2.0], angular: [0.0, 0.0, 3.0] }).unwrap();
    for i in 0..100 {
        step(&mut rigid, 0.01 * f64::from(i), 0.01, &mut NodeBatch::default());
    }
    let hand = &rigid.bodies()[0];
    let rotation = DQuat::from_xyzw(hand.rotation[1], hand.rotation[2], hand.rotation[3], hand.rotation[0]);
    within("position [m]", (DVec3::from_array(hand.position) - DVec3::new(1.0, 0.0, -2.0)).length(), 1e-13);
    within("angle [rad]", rotation.angle_between(DQuat::from_rotation_z(3.0)), 1e-13);
    let nan =
        rigid.act("hand", &Command::Twist { linear: [f64::NAN, 0.0, 0.0], angular: [0.0; 3] }).unwrap_err().to_string();
    assert!(nan.contains("'hand'") && nan.contains("NaN"), "{nan}");
    let fixed = rigid.act("wall", &Command::Twist { linear: [0.0; 3], angular: [0.0; 3] }).unwrap_err().to_string();
    assert!(fixed.contains("'wall'") && fixed.contains("not driven by velocity"), "{fixed}");
    let unknown = rigid.act("foot", &Command::Twist { linear: [0.0; 3], angular: [0.0; 3] }).unwrap_err().to_string();
    assert!(unknown.contains("'foot'") && unknown.contains("hand, wall"), "{unknown}");
    let joints = rigid.act("hand", &Command::JointTargets(vec![1.0])).unwrap_err().to_string();
    assert!(
        joints.contains("tool 'hand': it has no joints, and joint targets are asked for; give it a twist"),
        "{joints}"
    );
}

#[test]
fn surfaces_move_by_the_chord_twist() {
    // Sand that sticks to a turning blade must take the velocity of the point it sticks to, v + ω × r.
    let mut rigid = rigid(
        "[[tool]]\nname = 'wheel'\nshape = { sphere = { radius = 0.5 } }\ncontact = 'stick'\nmotion = { velocity = { linear = [1, 0, 0], angular = [0, 0, 2] } }",
    );
    let mut nodes = batch(&[([0.0, 0.4, 0.0], 1.0, [0.0; 3])]);
    step(&mut rigid, 0.0, 1e-3, &mut nodes);
    within("velocity [m/s]", (DVec3::from_array(nodes.velocity[0]) - DVec3::new(1.0 - 0.8, 0.0, 0.0)).length(), 1e-12);
}

#[test]
fn keyframes_that_make_no_path_are_refused() {
    // Unsorted times would make a tool jump; the message says what to mend.
    let tool = |frames: &str| {
        format!(
            "[[tool]]\nname = 'a'\nshape = {{ sphere = {{ radius = 0.1 }} }}\nmotion = {{ keyframes = {{ frames = [{frames}] }} }}"
        )
    };
    let unsorted = refusal(&tool("{ time = 1.0, position = [0, 0, 0] }, { time = 0.5, position = [0, 0, 0] }"));
    assert!(unsorted.contains("tool[0]") && unsorted.contains("do not rise"), "{unsorted}");
    let twisted = refusal(&tool("{ time = 1.0, position = [0, 0, 0], rotation = [0, 0, 0, 0] }"));
    assert!(twisted.contains("no quaternion"), "{twisted}");
    assert!(refusal(&tool("")).contains("no keyframes"));
    assert!(refusal(&tool("{ time = nan, position = [0, 0, 0] }")).contains("do not rise"));
    assert!(Pose::IDENTITY.rotation.is_normalized());
}
