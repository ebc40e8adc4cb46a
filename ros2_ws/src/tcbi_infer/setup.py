from setuptools import find_packages, setup

setup(
    name="tcbi_infer",
    version="0.1.0",
    packages=find_packages(exclude=["test"]),
    package_data={"tcbi_infer": ["**/*.toml", "**/*.json", "**/*.html", "**/*.css", "**/*.js", "**/*.safetensors"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/tcbi_infer"]),
        ("share/tcbi_infer", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=False,
    maintainer="The tcbi developers",
    maintainer_email="tcbi@example.org",
    description="Bags, statistics, TCBI, comparison, diagnosis and the inference node.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "recorder_node = tcbi_infer.recorder_node:main",
            "replay_node = tcbi_infer.replay_node:main",
            "inference_node = tcbi_infer.inference_node:main",
        ],
    },
)
