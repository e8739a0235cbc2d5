"""Runs the ROS 2 recipe of docs/listening.md without ROS and without a broker.

The recipe's file, then a file of messages as JSON: when, topic, payload, retained. Prints the poses that were published as
JSON: topic, frame, position, covariance, and how long before the message the stamp is.
"""
import json
import sys
import time
import types

recipe, messages = sys.argv[1:]
clients, poses = [], []
now_s = 0.0
# A day of the wall's clock that is nobody's.
DAY_NS = 1_700_000_000_000_000_000


def module(name, **names):
    made = types.ModuleType(name)
    vars(made).update(names)
    sys.modules[name] = made
    return made


class Nanoseconds:
    def __init__(self, seconds=0.0, nanoseconds=0):
        self.nanoseconds = nanoseconds + round(1e9 * seconds)

    def __sub__(self, other):
        return Nanoseconds(nanoseconds=self.nanoseconds - other.nanoseconds)

    def to_msg(self):
        return self.nanoseconds


class Pose:
    def __init__(self):
        space = types.SimpleNamespace
        inner = space(position=space(x=0.0, y=0.0, z=0.0), orientation=space(x=0.0, y=0.0, z=0.0, w=0.0))
        self.header = space(frame_id="", stamp=None)
        self.pose = space(pose=inner, covariance=[0.0] * 36)


class Publisher:
    def __init__(self, topic):
        self.topic = topic

    def publish(self, pose):
        place = pose.pose.pose.position
        poses.append({
            "topic": self.topic,
            "frame": pose.header.frame_id,
            "position_m": [place.x, place.y, place.z],
            "covariance": pose.pose.covariance,
            "before_s": (DAY_NS + round(1e9 * now_s) - pose.header.stamp) / 1e9,
        })


class Node:
    def create_publisher(self, kind, topic, depth):
        assert kind is Pose and depth > 0
        assert all(topic != known for known in self.known), topic
        self.known.append(topic)
        return Publisher(topic)

    def get_clock(self):
        clock = lambda: Nanoseconds(seconds=now_s, nanoseconds=DAY_NS)
        return types.SimpleNamespace(now=clock)

    known = []


class Client:
    def __init__(self, version):
        assert version == "VERSION2"
        self.subscribed = []
        clients.append(self)

    def connect(self, host):
        self.host = host

    def loop_start(self):
        # Twice: a line that was lost is made anew, and knows nothing.
        for _ in range(2):
            self.subscribed.clear()
            self.on_connect(self, None, None, 0, None)
        assert self.subscribed == ["lighthouse/+/+"]

    def subscribe(self, topic):
        self.subscribed.append(topic)


def spin(node):
    global now_s
    [client] = clients
    with open(messages, encoding="utf-8") as file:
        said = json.load(file)
    for at_s, topic, payload, retain in said:
        now_s = at_s
        client.on_message(client, None, types.SimpleNamespace(topic=topic, payload=payload.encode(), retain=retain))


time.monotonic = lambda: now_s
paho = module("paho")
paho.mqtt = module("paho.mqtt")
paho.mqtt.client = module(
    "paho.mqtt.client", Client=Client, CallbackAPIVersion=types.SimpleNamespace(VERSION2="VERSION2")
)
rclpy = module("rclpy", init=lambda: None, create_node=lambda name: Node(), spin=spin)
rclpy.duration = module("rclpy.duration", Duration=Nanoseconds)
module("geometry_msgs")
module("geometry_msgs.msg", PoseWithCovarianceStamped=Pose)

with open(recipe, encoding="utf-8") as file:
    exec(compile(file.read(), recipe, "exec"), {"__name__": "__main__"})
print(json.dumps(poses))
