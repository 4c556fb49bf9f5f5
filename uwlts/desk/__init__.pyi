from .operator_page import serve_desk as serve_desk
from .scan import serve_ros as serve_ros
