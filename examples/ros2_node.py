"""Track a ROS 2 camera and publish tf by REP 105: map -> odom -> base_link. Images have an optical frame (REP 103), which tf joins to base_link.
With -p odometry:=true another node publishes odom -> base_link, and this one only corrects it by map -> odom; else map and odom are one.
python examples/ros2_node.py --ros-args -r rgb:=/camera/color/image_raw -r depth:=... (registered to rgb) -r camera_info:=/camera/color/camera_info
"""

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import trihedron as th

FLU_OPTICAL = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]], float)  # forward-left-up <- optical
CHANNELS = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4, "mono8": 1}


def pixels_of(message: Any, dtype: np.dtype[Any], channels: int) -> Any:
    rows = np.frombuffer(bytes(message.data), np.uint8).reshape(message.height, -1)[:, : message.width * channels * dtype.itemsize].copy()
    return rows.view(dtype.newbyteorder(">" if message.is_bigendian else "<")).reshape(message.height, message.width, channels)


def color_of(message: Any) -> Any:
    image = pixels_of(message, np.dtype(np.uint8), CHANNELS[message.encoding])[:, :, :3]
    return image[:, :, ::-1] if message.encoding.startswith("bgr") else np.repeat(image, 3 // image.shape[2], axis=2)


def depth_of(message: Any) -> Any:  # REP 118: float metres with NaN for none, or millimetres with 0
    dtype = np.dtype(np.float32 if message.encoding == "32FC1" else np.uint16)
    image = pixels_of(message, dtype, 1)[:, :, 0].astype(np.float32)
    return image / 1000 if dtype.itemsize == 2 else np.nan_to_num(image, nan=0.0, posinf=0.0, neginf=0.0)


def camera_of(info: Any) -> th.Camera:
    return th.Camera(info.width, info.height, info.k[0], info.k[4], info.k[2], info.k[5], distortion=tuple(info.d[:5]) if any(info.d) else ())


def matrix_of(transform: Any) -> Any:
    t, q = transform.translation, transform.rotation
    return np.vstack([np.column_stack([Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix(), (t.x, t.y, t.z)]), (0, 0, 0, 1)])


def fill(transform: Any, T: Any) -> None:
    (t, q), places = (transform.translation, transform.rotation), Rotation.from_matrix(T[:3, :3]).as_quat()
    t.x, t.y, t.z, q.x, q.y, q.z, q.w = (float(value) for value in (*T[:3, 3], *places))


def main() -> None:
    import message_filters
    import rclpy
    from geometry_msgs.msg import TransformStamped
    from sensor_msgs.msg import CameraInfo, Image
    from tf2_ros import Buffer, TransformBroadcaster, TransformListener

    rclpy.init()
    node, slams, tf = rclpy.create_node("trihedron"), [], Buffer()
    broadcaster, _, external = TransformBroadcaster(node), TransformListener(tf, node), node.declare_parameter("odometry", False).value

    def track(rgb: Any, depth: Any, info: Any) -> None:
        now, mount, inverse = rclpy.time.Time(), FLU_OPTICAL, np.linalg.inv  # without tf of the mount, base_link is the camera
        if tf.can_transform("base_link", rgb.header.frame_id, now):
            mount = matrix_of(tf.lookup_transform("base_link", rgb.header.frame_id, now).transform)
        slam = slams[0] if slams else slams.append(th.Slam(camera_of(info))) or slams[0]
        pose = slam.track(color_of(rgb), depth_of(depth), rgb.header.stamp.sec + rgb.header.stamp.nanosec / 1e9)
        if pose.status == "lost" or (external and not tf.can_transform("odom", "base_link", now)):
            return
        T_map_base = mount @ pose.T_world_camera @ inverse(mount)
        T_odom_base = matrix_of(tf.lookup_transform("odom", "base_link", now).transform) if external else T_map_base
        for parent, child, T in (("map", "odom", T_map_base @ inverse(T_odom_base)), ("odom", "base_link", T_odom_base))[: 1 if external else 2]:
            sent = TransformStamped(child_frame_id=child)
            sent.header.stamp, sent.header.frame_id = rgb.header.stamp, parent
            fill(sent.transform, T)
            broadcaster.sendTransform(sent)

    inputs = [message_filters.Subscriber(node, kind, name) for kind, name in ((Image, "rgb"), (Image, "depth"), (CameraInfo, "camera_info"))]
    message_filters.ApproximateTimeSynchronizer(inputs, 5, 0.02).registerCallback(track)
    rclpy.spin(node)


if __name__ == "__main__":
    main()
