"""A ROS 2 node that acts by a policy of two joints: python examples/ros2.py, beside policy.safetensors"""

import rclpy
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

import quad_rl

JOINTS = ["shoulder", "elbow"]  # as the controller's parameter `joints` has them

class Acting(Node):
    def __init__(self):
        super().__init__("policy")
        policy = quad_rl.Policy.load("policy.safetensors")
        self.names, self.episode = policy.action_names, policy.begin(0)  # ["torque.elbow", "torque.shoulder"]
        assert len({*self.names}) == policy.action_size, "each number needs its own name"
        self.commands = self.create_publisher(Float64MultiArray, "commands", 1)
        self.create_subscription(JointState, "joint_states", self.act, 1)

    def act(self, state):
        seen = {f"position.{joint}": number for joint, number in zip(state.name, state.position)}
        seen |= {f"velocity.{joint}": number for joint, number in zip(state.name, state.velocity)}
        try:
            action = dict(zip(self.names, self.episode.act(seen).tolist()))
        except ValueError as error:
            self.get_logger().error(f"no command: {error}")
            return
        self.commands.publish(Float64MultiArray(data=[action[f"torque.{joint}"] for joint in JOINTS]))

rclpy.init()
rclpy.spin(Acting())
