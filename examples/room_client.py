"""Follow a room, or stop it, from a program of one's own.

python examples/room_client.py http://127.0.0.1:8080            # what happens, until Ctrl-C
python examples/room_client.py http://127.0.0.1:8080 --stop     # STOP
"""

import argparse
import contextlib

from service.client import RefusedByServiceError, RoomClient, ServiceGoneError

parser = argparse.ArgumentParser(
    description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
)
parser.add_argument("url")
parser.add_argument("--token", default="", help="where the room asks for one")
parser.add_argument("--stop", action="store_true")
arguments = parser.parse_args()

try:
    with RoomClient(arguments.url, token=arguments.token, by="room_client.py") as room:
        if arguments.stop:
            room.stop()
            raise SystemExit(0)
        state = room.state()
        print(f"{state.robot.phase}: {state.prompt}")
        with contextlib.suppress(KeyboardInterrupt):
            for message in room.live():
                if message.kind == "record":
                    print(message.body["kind"], message.body["body"])
except (ServiceGoneError, RefusedByServiceError) as error:
    raise SystemExit(str(error)) from None
