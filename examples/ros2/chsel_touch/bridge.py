"""From ROS messages to a session and back, without an import of ROS."""

import numpy as np

from chsel.problem.poses import apply, inverse, quaternions
from runners.sensors.log.decoding import rigid
from runners.sensors.log.images import pixel_rows


class Bridge:
    """Feeds a session; transform_to_world(header) is a geometry_msgs/Transform."""

    def __init__(self, session, transform_to_world):
        self.session, self._transform = session, transform_to_world

    def contact(self, message):
        """Add a geometry_msgs/PointStamped, metres."""
        point = [[message.point.x, message.point.y, message.point.z]]
        self.session.add(contacts=apply(self._world_from(message.header), np.array(point)))

    def look(self, image, info):
        """Add the free space of a sensor_msgs/Image: 32FC1 in metres, or 16UC1 in millimetres."""
        size = image.width, image.height
        data, order = bytes(image.data), bool(image.is_bigendian)
        values = pixel_rows(data, image.encoding, size=size, step=image.step, big_endian=order)
        self.session.add(
            depth=values * (0.001 if values.dtype == np.uint16 else 1.0),
            camera=np.reshape(info.k, (3, 3)),
            world_from_camera=self._world_from(image.header),
        )

    def poses(self):
        """Positions (B, 3) and quaternions (B, 4), x y z w, of different poses, best first."""
        found = self.session.register()
        world_from_object = inverse(found.object_from_world[~found.duplicate])
        return world_from_object[:, :3, 3], quaternions(world_from_object[:, :3, :3])

    def _world_from(self, header):
        transform = self._transform(header)
        return rigid(transform.translation, transform.rotation)
