from glob import glob

from setuptools import find_packages, setup

package_name = "rov_ident"

setup(
    name=package_name,
    version="0.1.0",
    packages=find_packages(include=[package_name, f"{package_name}.*"]),
    package_data={
        f"{package_name}.dashboard": ["page/*", "*.json", "*.xml"],
        f"{package_name}.nodes": ["*.xml"],
        f"{package_name}.reports": ["*.css", "*.js", "uplot/*"],
    },
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package_name}"]),
        (f"share/{package_name}", ["package.xml"]),
        (f"share/{package_name}/config", glob("config/*")),
        (f"share/{package_name}/bags", glob("bags/*.mcap")),
        (f"share/{package_name}/launch", glob("launch/*.launch.py")),
    ],
    python_requires=">=3.10",
    # docs/dependencies.md says what each is for.
    install_requires=[
        "setuptools",
        "numpy>=1.26",
        "numba>=0.61,<0.69",  # the minors that bench/tools/versions.py was run with: docs/trust.md
        "scipy>=1.11",
        "threadpoolctl>=3.2",
        "filterpy>=1.4.5",
        "mcap>=1.6",
        "rosbags>=0.10",
        "zstandard>=0.21",
        "lz4>=4",
        "PyYAML>=6.0",
        "rich>=13",
        "matplotlib>=3.6",
        "aiohttp>=3.9",
        "shtab>=1.7",
    ],
    extras_require={
        # On a ROS 2 machine rclpy and the messages come from apt; these wheels stand in elsewhere.
        "wheels": ["ros-rclpy[fastrtps]==7.1.6", "ros-jazzy-common-interfaces"],
        "test": [
            "distributed>=2024.1",
            "foxglove-sdk>=0.14",
            "pytest",
            "pytest-timeout",
            "pytest-xdist",
            "hypothesis",
            "ipykernel>=6",
            "lxml>=5",
            "mcap-ros2-support",
            "mkdocs-material>=9.5",
            "nbclient>=0.8",
            "nbformat>=5.7",
            "pymdown-extensions<13",  # 13 is not for the Python 3.11.2 of Debian 12
            "pymavlink>=2.4.40",
            "pyulog>=1.0",
            "ruff",
            "mypy",
            "types-PyYAML",
        ],
        "bench": ["padasip>=1.2"],
        # fuzzing by coverage, in `make torture` where it is installed
        "fuzz": ["atheris>=3"],
        # `make docs`
        "docs": ["mkdocs>=1.6", "mkdocs-material>=9.5"],
        # `rov-ident import` of ArduSub's logs
        "ardupilot": ["pymavlink>=2.4.40"],
        # and of PX4's
        "px4": ["pyulog>=1.0"],
        # `rov-ident fit --dask`
        "dask": ["distributed>=2024.1"],
    },
    zip_safe=True,
    maintainer="rov_ident maintainers",
    maintainer_email="maintainers@users.noreply.github.com",
    description="Online identification of the hydrodynamic coefficients of underwater vehicles.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "rls_node = rov_ident.nodes.programs:rls_node",
            "ukf_node = rov_ident.nodes.programs:ukf_node",
            "example_controller = rov_ident.nodes.programs:example_controller",
            "controller_bridge = rov_ident.nodes.programs:controller_bridge",
            "dashboard_node = rov_ident.nodes.programs:dashboard_node",
            "rov-ident = rov_ident.cli:main",
        ]
    },
)
